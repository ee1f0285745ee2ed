"""Mistakes with bags and the error line of each; their files: `cli/test_bag_mistakes.py`."""

from __future__ import annotations

from tests.builders.advice import OUSTER

# As in `mistakes.py`.
BAG_MISTAKES: dict[str, tuple[str, int, str]] = {
    "clouds only": (
        "clouds.db3",
        1,
        "clouds.db3: /points: expected a message of little-endian CDR (00 01 00 00), found 00 00 "
        "00 00; convert the recording to that encoding, or leave the topic out with --ignore "
        "/points",
    ),
    "clouds without times": (
        "timeless.db3",
        1,
        "timeless.db3: /points: expected the time of each point in a field t, time, timestamp, "
        "time_stamp, timestamps, offset_time or ts, found x, y, z; none of them rises within "
        "the scan as times do: record the raw packets, or clouds with times, or leave the topic "
        "out with --ignore /points",
    ),
    "one of two lidars": (
        "drive.mcap --rig one.yaml",
        1,
        "one.yaml: sensor left: expected packets of one lidar, found those of several "
        "(OS-0-32-U1, OS-1-32-U1) on /left/ouster/lidar_packets, /right/ouster/lidar_packets; "
        "name its stream (source_ip, port, topic or serial)",
    ),
    "topic of the rig": (
        "drive.mcap --rig topic.yaml",
        1,
        "topic.yaml: sensor left: expected a packet of it (topic /left/ouster/lidar) in the first "
        "10 seconds, found none to decide which of /left/ouster/metadata, /right/ouster/metadata "
        "is its metadata; correct its stream, or give `metadata:`",
    ),
    "topic of no packets": (
        "drive.mcap --rig points.yaml",
        1,
        "points.yaml: sensor imu: expected a packet of it (topic /imu/data) in the first 10 "
        "seconds, found none to decide which of /left/ouster/metadata, /right/ouster/metadata is "
        "its metadata; correct its stream, or give `metadata:`",
    ),
    "topic and port": (
        "drive.mcap --rig both.yaml",
        1,
        "both.yaml:2: sensors[0].stream.topic: expected topic without port, found port as well "
        "(line 2); keep one of the two",
    ),
    "frame of the rig": (
        "drive.mcap --rig frame.yaml",
        1,
        "sensor left: extrinsics by frame (os_lft): expected a frame of the recording's "
        "transforms, found 'os_lft'; it has base_link, left/os_sensor, right/os_sensor; correct"
        " it, or give translation_m and a rotation",
    ),
    "folder without a bag": (
        "papers",
        1,
        "papers: expected a recording, found a folder without .db3 or .mcap files; name the files"
        " inside it",
    ),
    "two kinds in a folder": (
        "mixed",
        1,
        "mixed: expected a folder with the files of one bag, found several kinds (MCAP, ROS 2 bag"
        " (sqlite3)); name the files of one kind",
    ),
    "text": (
        "text.db3",
        1,
        "text.db3: expected a recording ({*}; also gzip or zstd of them), found a file that "
        "begins with 68 65 6c 6c 6f 0a; check that it is the right file",
    ),
    "empty database": (
        "empty.db3",
        1,
        "empty.db3: expected a recording, found 0 bytes; record or copy it again",
    ),
    "another database": (
        "other.db3",
        1,
        "other.db3: expected a ROS 2 bag (tables topics and messages), found a database that "
        "cannot be read ({*}); record or copy it again, or try `sqlite3 "
        ".recover`",
    ),
    "cut MCAP": (
        "head.mcap",
        1,
        "head.mcap: no lidar packets; expected raw UDP packets of a supported lidar (see `mlbatch "
        "sensors`), found no UDP packet at all; check that the recording contains the sensor's "
        "data port (head.mcap: byte 20: the file ends within a record: expected its footer; the "
        "rest was read)",
    ),
    "cut ROS 1 bag": (
        "head.bag",
        1,
        "head.bag: no lidar packets; expected raw UDP packets of a supported lidar (see `mlbatch "
        "sensors`), found no UDP packet at all; check that the recording contains the sensor's "
        "data port (head.bag: the bag ends within its header, head.bag: byte 13: the bag ends "
        "within a record; it was cut off)",
    ),
    "cut database": (
        "head.db3",
        1,
        "head.db3: expected a ROS 2 bag (tables topics and messages), found a database that "
        "cannot be read ({*}); record or copy it again, or try "
        "`sqlite3 .recover`",
    ),
    "output inside": (
        "bag -o bag/scans",
        1,
        "bag/scans: expected an output outside the recordings, found one inside bag; choose "
        "another folder",
    ),
    "output inside a file name": (
        "bag -o bag/scans.mcap",
        1,
        "bag/scans.mcap: expected an output outside the recordings, found one inside bag; choose "
        "another folder",
    ),
    "output over the bag": (
        "bag -o bag --overwrite",
        1,
        "bag: expected an output that is no recording, found one of the inputs; choose another "
        "name",
    ),
    "output over the file": (
        "drive.mcap -o drive.mcap --overwrite",
        1,
        "drive.mcap: expected an output that is no recording, found one of the inputs; choose "
        "another name",
    ),
    "strange metadata": (
        "stranger.db3",
        1,
        "stranger.db3: /roof/ouster/lidar_packets carries Ouster lidar, serial 111, 1280 bytes: "
        "needs its metadata; expected metadata that match, found only /roof/ouster/metadata; give "
        "the sensor's with --metadata FILE" + OUSTER,
    ),
    "garbage metadata": (
        "garbage.db3",
        1,
        "garbage.db3: /roof/ouster/lidar_packets carries Ouster lidar, serial 111, 1280 bytes: "
        "needs its metadata; expected metadata that match, found none in the recording's "
        "directory; give the sensor's with --metadata FILE (/roof/ouster/metadata: expected the "
        "metadata of a lidar, found another text)" + OUSTER,
    ),
    "no metadata": (
        "bare.db3",
        1,
        "bare.db3: /roof/ouster/lidar_packets carries Ouster lidar, serial 111, 1280 bytes: needs "
        "its metadata; expected metadata that match, found none in the recording's directory; "
        "give the sensor's with --metadata FILE" + OUSTER,
    ),
    "unknown topic to pass": (
        "drive.mcap --pass /imu/dat -o scans.mcap",
        2,
        "--pass /imu/dat: expected a topic of the recording, found none that matches; see "
        "`mlbatch inspect`",
    ),
    "existing folder": (
        "drive.mcap -o old --format rosbag2",
        1,
        "old: expected a new output, found an existing one; choose another or --overwrite",
    ),
    "existing bag": (
        "drive.mcap -o old.bag",
        1,
        "old.bag: expected a new output, found an existing one; choose another or --overwrite",
    ),
    "db3 output": (
        "drive.mcap -o scans.db3",
        2,
        "-o scans.db3: expected a folder, since rosbag2 output is a folder with an MCAP file, "
        "found a file name; give -o scans --format rosbag2",
    ),
    "mcap name for a ROS 1 bag": (
        "drive.mcap -o scans.mcap --format rosbag1",
        2,
        "-o scans.mcap: expected the name of a .bag file for --format rosbag1, found that of a "
        "mcap file; change .mcap or leave out the option",
    ),
    "bag name for npz": (
        "drive.mcap -o scans.bag --format npz",
        2,
        "-o scans.bag: expected a folder for --format npz, found the name of a rosbag1 file; "
        "leave out .bag or the option",
    ),
    "no extrinsics": (
        "unmounted.db3",
        1,
        "extrinsics unknown for left, right; required for every sensor when there are two or "
        "more; give them in a rig file (--rig), /tf_static or metadata (ouster-sdk extrinsic), or "
        "accept the body origin with --identity-extrinsics",
    ),
    "moving tf": (
        "moving.mcap",
        1,
        "extrinsics unknown for left; required for every sensor when there are two or more; give "
        "them in a rig file (--rig), /tf_static or metadata (ouster-sdk extrinsic), or accept the "
        "body origin with --identity-extrinsics (left: nothing connects frame left/os_sensor with "
        "base_link: /tf changes base_link -> mast during the recording)",
    ),
    "host clock": (
        "frames.db3 --clock host",
        2,
        "--clock host: sensor roof: expected the receive time of each packet, found only that of "
        "whole messages on /roof/ouster/frames; use --clock sensor (in the rig: clock.source) "
        "without --align-clocks, or record the packets with tcpdump",
    ),
    "strict contradiction": (
        "contrary.mcap --strict",
        1,
        "sensor left: its extrinsics of tf_static and of urdf differ by 50.0 mm and 0.00 "
        "degrees (base_link -> left/os_sensor); tf_static is used, correct the wrong one "
        "(extrinsics_contradict, an error because of --strict)",
    ),
    "only part": (
        "drive.mcap --only front",
        2,
        "--only: expected the name or serial number of a sensor, one of left, right, found "
        "'front'; choose one",
    ),
    "file of a bag that is gone": (
        "bag/bag_2.db3",
        1,
        "bag/bag_2.db3: expected a recording, found no such file; check the path",
    ),
}
