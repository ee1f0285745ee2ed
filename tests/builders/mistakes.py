"""Mistakes of users and the error line of each; their files: `cli/test_mistakes.py`."""

from __future__ import annotations

from tests.builders.advice import OUSTER

FIX = "fix/two_lidars.pcap --rig fix/rig.yaml"
DIGEST = "R/ouster/os0-128_v2.3.0_rng15/OS-0-128-U1_v2.3.0_1024x10_digest.json"
ONE_UNIT = "R/ouster/os0-128_v2.3.0_rng15/OS-0-128-U1_v2.3.0_1024x10"
PAIR = "R/ouster/two-sensors_same-ports_nonlegacy/same_ports_nonlegacy.pcap"
NO_LIDAR = (
    "no lidar packets; expected raw UDP packets of a supported lidar (see `mlbatch sensors`), "
    "found "
)
DATA_PORT = "; check that the recording contains the sensor's data port"

OTHER_MODE = (
    "found those of 512x10 (512 columns per revolution, measurement ids up to 255, columns 195.3 "
    "us apart): the mode changed after the metadata were saved, all azimuths would be wrong; save "
    "the metadata from the sensor again, or give those that were saved with this recording"
)

# (arguments after `convert`, exit code, message); `-o out` is added unless it is there. {*} matches
# words of the parser, which differ between its versions, and lists that grow.
MISTAKES: dict[str, tuple[str, int, str]] = {
    "nothing at all": ("-o out", 2, "Missing argument {*}; see `mlbatch --help`"),
    "misspelt option": (
        f"{FIX} --overwrit",
        2,
        "No such option: --overwrit{*}; see `mlbatch --help`",
    ),
    "no number": (
        f"{FIX} --slices many",
        2,
        "Invalid value for '--slices'{*}; see `mlbatch --help`",
    ),
    "missing recording": (
        "none.pcap",
        1,
        "none.pcap: expected a recording, found no such file; check the path",
    ),
    "folder": (
        "folders",
        1,
        "folders: expected a recording, found a folder without .db3 or .mcap files; "
        "name the files inside it",
    ),
    "empty file": (
        "empty.pcap",
        1,
        "empty.pcap: expected a recording, found 0 bytes; record or copy it again",
    ),
    "text": (
        "text.txt",
        1,
        "text.txt: expected a recording ({*}; also gzip or zstd of them), found a file that "
        "begins with 68 65 6c 6c 6f 0a; check that it is the right file",
    ),
    "no output": (
        f"{FIX} --quiet",
        2,
        "-o: expected an output, found none; give -o scans.mcap, or --dry-run",
    ),
    "file name for a folder": (
        f"{FIX} -o out.npz",
        2,
        "-o out.npz: expected a folder, since npz output is one file per scan, found a file name; "
        "give -o out --format npz",
    ),
    "format of others": (
        f"{FIX} --format e57",
        2,
        "--format: expected one of kitti, las, laz, mcap, npz, nuscenes, pcd, ply, rosbag1, "
        "rosbag2, found 'e57'; choose one",
    ),
    "folder format for a file": (
        f"{FIX} -o out.mcap --format ply",
        2,
        "-o out.mcap: expected a folder for --format ply, found the name of a mcap file; "
        "leave out .mcap or the option",
    ),
    "existing output": (
        f"{FIX} -o old",
        1,
        "old: expected a new output, found an existing one; choose another or --overwrite",
    ),
    "strangers in the output": (
        f"{FIX} -o old --overwrite",
        1,
        "old: expected a folder with nothing but scans to overwrite, found diary.txt in it; "
        "choose another output",
    ),
    "output folder missing": (
        f"{FIX} -o none/out",
        1,
        "none/out: expected an output in an existing folder, found no folder none; create it "
        "(mkdir -p) or choose another",
    ),
    "no name of an output": (
        f"{FIX} -o .",
        1,
        ".: expected the name of a new output, found a folder; add a name",
    ),
    "output over a rig": (
        "fix/two_lidars.pcap --rig fix/rig.yaml -o fix/rig.yaml --format mcap --overwrite",
        1,
        "fix/rig.yaml: expected an output that does not overwrite fix/rig.yaml, found one that "
        "does; choose another name",
    ),
    "report over the growing output": (
        f"{FIX} -o out.mcap --report out.mcap.partial",
        1,
        "out.mcap.partial: expected a report that is no file of the output, found one; choose "
        "another name for the report",
    ),
    "report over a scan": (
        f"{FIX} -o out --report out/000000.npz",
        1,
        "out/000000.npz: expected a report that is no file of the output, found one; choose "
        "another name for the report",
    ),
    "report in a folder that a dry run does not make": (
        f"{FIX} -o out --dry-run --report out/r.json",
        1,
        "out/r.json: expected a report in an existing folder, found none at out; create it (mkdir "
        "-p) or choose another",
    ),
    "report folder missing": (
        f"{FIX} --report none/r.json",
        1,
        "none/r.json: expected a report in an existing folder, found none at none; create it "
        "(mkdir -p) or choose another",
    ),
    "report is a folder": (
        f"{FIX} --report old",
        1,
        "old: expected a file for the report, found a folder; add a name",
    ),
    "report over metadata of the rig": (
        f"{FIX} --report fix/left.json",
        1,
        "fix/left.json: expected a new file or an earlier report, found another file; choose "
        "another name for the report",
    ),
    "report over a device": (
        f"{FIX} --report /dev/null",
        1,
        "/dev/null: expected a new file or an earlier report, found another file; choose another "
        "name for the report",
    ),
    "report over the recording": (
        f"{FIX} --report fix/two_lidars.pcap",
        1,
        "fix/two_lidars.pcap: expected a new file for the report, found an input; choose another",
    ),
    "rate no number": (
        f"{FIX} --rate fast",
        2,
        "--rate: expected a positive number of Hz (10, 29.97 or 10/3), found 'fast'; write a "
        "decimal number or a fraction",
    ),
    "rate too low": (
        f"{FIX} --rate 0.1",
        2,
        "--rate: expected 0.25 to 1000000 Hz, found '0.1'; lidars run at 5 to 20 Hz",
    ),
    "no slices": (
        f"{FIX} --slices 0",
        2,
        "--slices: expected a whole number from 1 to 10000, found 0; leave it out for 1",
    ),
    "wait": (
        f"{FIX} --max-wait soon",
        2,
        "--max-wait: expected seconds above 0, or inf, found 'soon'; write 1.0",
    ),
    "no wait": (
        f"{FIX} --max-wait 0",
        2,
        "--max-wait: expected seconds above 0, or inf, found '0'; write 1.0",
    ),
    "box of three": (
        f"{FIX} --exclude-box 1,2,3",
        2,
        "--exclude-box: expected x0,y0,z0,x1,y1,z1 in metres with x0 < x1, y0 < y1, z0 < z1, "
        "found '1,2,3'; write --exclude-box=-1,-1,0,1,1,2",
    ),
    "box inside out": (
        f"{FIX} --exclude-box=1,0,0,-1,1,1",
        2,
        "--exclude-box: expected x0,y0,z0,x1,y1,z1 in metres with x0 < x1, y0 < y1, z0 < z1, "
        "found '1,0,0,-1,1,1'; write --exclude-box=-1,-1,0,1,1,2",
    ),
    "negative range": (
        f"{FIX} --min-range=-1",
        2,
        "--min-range: expected 0 or more metres, found -1.0; write 0.5",
    ),
    "range nan": (
        f"{FIX} --max-range nan",
        2,
        "--max-range: expected more than --min-range (0.0 m), found nan m; write 100",
    ),
    "ranges swapped": (
        f"{FIX} --min-range 5 --max-range 3",
        2,
        "--max-range: expected more than --min-range (5.0 m), found 3.0 m; write 100",
    ),
    "start no time": (
        f"{FIX} --start yesterday",
        2,
        "--start: expected epoch seconds, an ISO time or +SECONDS, found 'yesterday'; write "
        "1700000000.5, 2026-05-01T12:00:00 or +12.5",
    ),
    "end before start": (
        f"{FIX} --start +3 --end +2",
        2,
        "--end: expected a time after --start (3 s), found 2 s; swap them",
    ),
    "date for an uptime clock": (
        "uptime/drive.pcap --start 2026-05-04T08:00",
        2,
        "--start/--end: expected seconds, since the sensors' clock has no date (timescale "
        "uptime), found a date; write +SECONDS after the first scan",
    ),
    "start after the end": (
        "uptime/drive.pcap --start +60",
        1,
        "uptime/drive.pcap: no scan: expected --start in the recording, from 1000 s to "
        "1000.299804687 s, found 1060.1 s; choose another",
    ),
    "clock": (
        f"{FIX} --clock gps",
        2,
        "--clock: expected sensor or host, found 'gps'; choose one",
    ),
    "layout": (
        f"{FIX} --layout round",
        2,
        "--layout: expected dense or organized, found 'round'; choose one",
    ),
    "organized ply": (
        f"{FIX} --format ply --layout organized",
        2,
        "--layout organized: expected dense for ply, found organized; write npz or mcap",
    ),
    "point layout": (
        f"{FIX} -o out.mcap --point-layout loam",
        2,
        "--point-layout: expected one of standard, velodyne, ouster, hesai, autoware, kiss-icp, "
        "minimal, found 'loam'; choose one",
    ),
    "jobs": (
        f"{FIX} --jobs 0",
        2,
        "--jobs: expected 1 to 64, or auto, found 0; give the number of free cores",
    ),
    "level of compression": (
        f"{FIX} -o x.mcap --compression zstd:23",
        2,
        "--compression: expected none, lz4, zstd or zstd:1 to zstd:22, found 'zstd:23'; choose one",
    ),
    "compression of files of scans": (
        f"{FIX} --compression lz4",
        2,
        "--compression: expected none for npz, found 'lz4'; leave it out, or write a .mcap or "
        "rosbag2 output",
    ),
    "decoder option": (
        f"{FIX} --decode crc=no",
        2,
        "--decode crc: expected check, found 'no'; write --decode crc=check",
    ),
    "unknown sensor": (
        f"{FIX} --only front",
        2,
        "--only: expected the name or serial number of a sensor, one of left, right, found "
        "'front'; choose one",
    ),
    "no sensor left": (
        f"{FIX} --ignore left --ignore 122648000456",
        2,
        "--only/--ignore: expected at least one sensor to convert, found none that is left; leave "
        "one of them out",
    ),
    "rig missing": (
        "fix/two_lidars.pcap --rig none.yaml",
        1,
        "none.yaml: expected a readable file, found no such file or directory; check the path",
    ),
    "rig without sensors": (
        "fix/two_lidars.pcap --rig empty.yaml",
        1,
        "empty.yaml:1: sensors: expected 1 to 256 sensors, found a list of 0; list each sensor "
        "with `- name:`",
    ),
    "misspelt key": (
        "fix/two_lidars.pcap --rig misspelt.yaml",
        1,
        "misspelt.yaml:2: sensors[0].extrinsic: expected a key of name, model, stream, metadata, "
        "extrinsics, clock, min_range_m, max_range_m, optional, decode, points, found 'extrinsic'; "
        "the nearest known key is extrinsics",
    ),
    "rig sensor of no stream": (
        "fix/two_lidars.pcap --rig fix/astray.yaml",
        1,
        "fix/astray.yaml: sensor rear: expected a packet of it (source_ip 10.5.5.99) in the first "
        "10 seconds, found none to decide its model; correct its stream, or give `metadata:` or "
        "`model:`",
    ),
    "rig sensor that is silent": (
        "fix/two_lidars.pcap --rig fix/silent.yaml",
        1,
        "fix/silent.yaml: sensor rear: expected its packets, found none from source_ip 10.5.5.99; "
        "correct its stream or serial, or set `optional: true`",
    ),
    "rig with the metadata of another unit": (
        "pair/drive.pcap --rig serials.yaml",
        1,
        "serials.yaml: sensor right: expected packets of serial number 333, that of its metadata "
        "other/333.json, found none, but those of Ouster lidar, serial 222, 1280 bytes: needs its "
        "metadata (10.0.0.2 > port 7502); give the metadata of the lidar that was recorded, "
        "correct its stream, or set `optional: true`",
    ),
    "rig sensor without metadata": (
        "bare/drive.pcap --rig serial.yaml",
        1,
        "serial.yaml: sensor left: no metadata with serial number 5 among the files given; give it "
        "as `metadata:` of the sensor, or with --metadata",
    ),
    "extrinsics by frame": (
        "fix/two_lidars.pcap --rig fix/frame.yaml",
        1,
        "sensor left: extrinsics by frame (os_left) need a recording with /tf_static, which "
        "captures do not have; give translation_m and a rotation",
    ),
    "metadata missing": (
        "fix/two_lidars.pcap --metadata none.json",
        1,
        "none.json: expected a calibration file, found no such file; check the path",
    ),
    "metadata is something else": (
        "fix/two_lidars.pcap --metadata fix/rig.yaml",
        1,
        "fix/rig.yaml: expected the metadata or calibration of a lidar, found another kind of "
        "file; give the file that the sensor's driver or recording software saved",
    ),
    "metadata of another lidar": (
        "bare/drive.pcap --metadata pair/222.json",
        1,
        "bare/drive.pcap: 10.0.0.1 > port 7502 carries Ouster lidar, serial 111, 1280 bytes: "
        "needs its metadata; expected metadata that match, found only 222.json; give the sensor's "
        "with --metadata FILE" + OUSTER,
    ),
    "metadata saved before a change of mode": (
        "mode/drive.pcap",
        1,
        "mode/drive.pcap: 10.0.0.1 > port 7502: mode/111.json: Ouster metadata, lidar_mode: "
        f"expected packets of 1024x10, {OTHER_MODE} (without a match: 111.json)",
    ),
    "metadata of another mode in the rig": (
        "mode/drive.pcap --rig mode.yaml",
        1,
        "mode.yaml: sensor left: mode/111.json: Ouster metadata, lidar_mode: expected packets of "
        f"1024x10, {OTHER_MODE}",
    ),
    "beams with the sign turned": (
        "turned/drive.pcap --metadata turned/111.json",
        1,
        "turned/111.json: Ouster metadata, beam_altitude_angles: expected angles that fall from "
        "the top beam to the lowest, found -20 to 20 degrees, as if their sign were turned; save "
        "the metadata from the sensor again",
    ),
    "no metadata": (
        "bare/drive.pcap",
        1,
        "bare/drive.pcap: 10.0.0.1 > port 7502 carries Ouster lidar, serial 111, 1280 bytes: "
        "needs its metadata; expected metadata that match, found none in the recording's "
        "directory; give the sensor's with --metadata FILE" + OUSTER,
    ),
    "two lidars without extrinsics": (
        "pair/drive.pcap",
        1,
        "extrinsics unknown for ouster_111, ouster_222; required for every sensor when there are "
        "two or more; give them in a rig file (--rig), /tf_static or metadata (ouster-sdk "
        "extrinsic), or accept the body origin with --identity-extrinsics",
    ),
    "incomparable clocks": (
        "apart/drive.pcap --identity-extrinsics",
        1,
        "clocks of the sensors cannot be compared: expected at most 1 s between them, found "
        "3600.000 s (1 whole hour(s): a time zone, or the wrong hour): stamp minus receive time is "
        "-0.001 s for ouster_111 and -3600.001 s for ouster_222; use --align-clocks or --clock "
        "host, or give clock.offset_s or clock.epoch in the rig",
    ),
    "strict with a duplicate": (
        "twice/drive.pcap --strict",
        1,
        "sensor ouster_111: expected no rejected packet because of --strict, found 1 rejected as "
        "duplicate; leave --strict out to count them instead",
    ),
    "strict with a warning": (
        "cut/drive.pcap --strict",
        1,
        "drive.pcap: byte 127134: the file ends within a record; expected 1338 bytes, found 1000 "
        "(cut_off, an error because of --strict)",
    ),
    # Two whole windows of 512 columns with 16 points, of two lidars.
    "millimetres for --min-range": (
        "pair/drive.pcap --identity-extrinsics --min-range 500",
        1,
        "pair/drive.pcap: no scan with points: expected points within the limits, found that all "
        "32768 were removed: 32768 by --min-range and --max-range (min_range_m, max_range_m of the "
        "rig); widen the range, or make the boxes smaller: both are in metres",
    ),
    "a box around everything": (
        "pair/drive.pcap --identity-extrinsics --exclude-box=-9,-9,-9,9,9,9 -o out.mcap",
        1,
        "pair/drive.pcap: no scan with points: expected points within the limits, found that all "
        "32768 were removed: 32768 by --exclude-box (exclude_boxes_m of the rig); widen the "
        "range, or make the boxes smaller: both are in metres",
    ),
    "only partial scans": (
        "short/drive.pcap",
        1,
        "short/drive.pcap: no scan: expected a whole window of 100 ms with all sensors, found "
        "ouster_111 from 1800000000.020000 to 1800000000.119805 s; write the partial ones with "
        "--keep-partial",
    ),
    "no common window": (
        "parted/drive.pcap --identity-extrinsics --max-wait inf --end 1800000001",
        1,
        "parted/drive.pcap: no scan: expected a whole window of 100 ms with all sensors, found "
        "ouster_111 from 1800000000.020000 to 1800000000.319805 s; ouster_222 from "
        "1800000009.020000 to 1800000009.319805 s; choose another --start/--end, or a recording "
        "where all sensors run together",
    ),
}

REAL_MISTAKES: dict[str, tuple[str, int, str]] = {
    "metadata is a digest": (
        f"{ONE_UNIT}.pcap --metadata {DIGEST}",
        1,
        f"{DIGEST}: expected the metadata or calibration of a lidar, found another kind of file; "
        "give the file that the sensor's driver or recording software saved",
    ),
    "TCP only": (
        "R/other/sick-tcp_pcapng/test.pcapng",
        1,
        f"R/other/sick-tcp_pcapng/test.pcapng: {NO_LIDAR}no UDP packet at all{DATA_PORT}",
    ),
    "look-alike": (
        "R/other/lslidar-1212-byte-lookalike/VLI-16-one-packet.pcap",
        1,
        "R/other/lslidar-1212-byte-lookalike/VLI-16-one-packet.pcap: "
        f"{NO_LIDAR}192.168.1.200 > port 2368 (1212 bytes: "
        f"LSLIDAR-like, 1212 bytes: not supported){DATA_PORT}",
    ),
    "empty capture": (
        "R/ouster/empty-pcap/empty_pcap.pcap",
        1,
        f"R/ouster/empty-pcap/empty_pcap.pcap: {NO_LIDAR}no UDP packet at all{DATA_PORT}",
    ),
    "lidar off": (
        "R/ouster/os0-128_imu-zone-no-lidar/imu_zm_no_lidar.pcap",
        1,
        f"R/ouster/os0-128_imu-zone-no-lidar/imu_zm_no_lidar.pcap: {NO_LIDAR}127.0.0.1 > port 7513 "
        "(452 bytes: Ouster IMU, serial 122247000785, 452 bytes), 127.0.0.1 > port 7514 (680 "
        f"bytes: Ouster zone monitor, serial 122247000785, 680 bytes){DATA_PORT}",
    ),
    "two uptime clocks": (
        f"{PAIR} --identity-extrinsics",
        1,
        "clocks of the sensors cannot be compared: expected at most 1 s between them, found "
        "4923.190 s: stamp minus receive time is -1718733565.190 s for ouster_122239000672 and "
        "-1718728642.000 s for ouster_122247000785; use --align-clocks or --clock host, or give "
        "clock.offset_s or clock.epoch in the rig",
    ),
    "one revolution is never a whole window": (
        f"{ONE_UNIT}.pcap",
        1,
        f"{ONE_UNIT}.pcap: no scan: expected a whole window of 100 ms with all sensors, found "
        "ouster_122150000150 from 1462.559462 to 1462.659327 s; write the partial ones with "
        "--keep-partial",
    ),
}
