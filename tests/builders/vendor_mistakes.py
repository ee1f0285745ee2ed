"""Mistakes with lidars of all vendors, and error lines; files: `cli/test_vendor_mistakes.py`."""

from __future__ import annotations

from tests.builders.advice import HESAI

_PLACED = "extrinsics: {matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}"
_LEFT = f"name: left, metadata: silent/111.json, stream: {{source_ip: 10.0.0.1}}, {_PLACED}"
_TOP = f"name: top, stream: {{source_ip: 10.0.0.8}}, {_PLACED}"

# Sensors of the rigs, by the name of the file.
RIGS: dict[str, tuple[str, ...]] = {
    "any": ("name: top",),
    "cloud_csv": ("name: top, stream: {topic: /points}, metadata: files/xt16.csv",),
    "firing": ("name: top, decode: {firing_azimuth: maybe}",),
    "helios32": ("name: top, model: Helios 32",),
    "lite": ("name: top, model: Puck LITE",),
    "livox": ("name: top, model: Livox SDK2",),
    "os1": ("name: top, model: OS1-32",),
    "rs16_csv": ("name: top, metadata: files/rs16.csv",),
    "serial": ('name: top, stream: {serial: "77"}',),
    "silent": (_LEFT, _TOP),
    "silent_csv": (_LEFT, f"{_TOP}, metadata: files/xt16.csv"),
    "silent_helios": (_LEFT, f"{_TOP}, model: Helios 16"),
    "silent_livox": (_LEFT, f"{_TOP}, model: Livox SDK2"),
    "silent_vlp16": (_LEFT, f"{_TOP}, model: VLP-16"),
    "two": (f"name: front, {_PLACED}", f"name: rear, {_PLACED}"),
    "same": (
        f"name: front, model: VLP-16, {_PLACED}",
        f"name: rear, stream: {{port: 2368}}, {_PLACED}",
    ),
    "vlp16": ("name: top, model: VLP-16",),
    "vlp32c": ("name: top, model: VLP-32C",),
    "hdl32e_yml": ("name: top, model: VLP-32C, metadata: files/hdl32e.yml",),
    "vlp32c_yml": ("name: top, metadata: files/vlp32c.yml",),
    "vlp61": ("name: top, model: VLP-61",),
    "small": ("name: top, model: vls-128",),
    "xt16": ("name: top, model: PandarXT-16",),
    "xt16_csv": ("name: top, metadata: files/xt16.csv",),
    "folder": ("name: top, metadata: files",),
}

# As in `mistakes.py`.
VENDOR_MISTAKES: dict[str, tuple[str, int, str]] = {
    "HESAI without its angles": (
        "xt16_bare/drive.pcap",
        1,
        "xt16_bare/drive.pcap: 10.0.0.8 > port 2368 carries HESAI lidar PandarXT-16, strongest "
        "return; expected metadata that match, found none in the recording's directory; give the "
        "sensor's with --metadata FILE" + HESAI,
    ),
    "angles of another HESAI next to the recording": (
        "xt16_other/drive.pcap",
        1,
        "xt16_other/drive.pcap: 10.0.0.8 > port 2368 carries HESAI lidar PandarXT-16, strongest "
        "return; expected metadata that match, found only 32.csv; give the sensor's with "
        "--metadata FILE" + HESAI,
    ),
    "angles of another HESAI": (
        "xt16_bare/drive.pcap --metadata xt16_other/32.csv",
        1,
        "xt16_bare/drive.pcap: 10.0.0.8 > port 2368 carries HESAI lidar PandarXT-16, strongest "
        "return; expected metadata that match, found only 32.csv; give the sensor's with "
        "--metadata FILE" + HESAI,
    ),
    "angles of another HESAI with as many channels": (
        "qt64/drive.pcap --metadata files/p64.csv",
        1,
        "qt64/drive.pcap: 10.0.0.8 > port 2368: files/p64.csv: expected elevations of a "
        "PandarQT64, -52.1 to 52.1 deg, found -24.9 to 14.9, the file of another model; give the "
        "one of this lidar (without a match: p64.csv)",
    ),
    "angles of another ROBOSENSE with as many lines": (
        "bpearl/drive.pcap --metadata files/rs32_other.csv",
        1,
        "bpearl/drive.pcap: 10.0.0.8 > port 6699: files/rs32_other.csv: expected elevations of a "
        "RS-Bpearl v4, 0 to 90 deg, found -25.0 to 15.0, the file of another model; give the one "
        "of this lidar (without a match: rs32_other.csv)",
    ),
    "angles of another Velodyne than the rig names": (
        "vlp32c/drive.pcap --rig hdl32e_yml.yaml",
        1,
        "hdl32e_yml.yaml: sensor top: files/hdl32e.yml: Velodyne calibration: expected vertical "
        "angles of a VLP-32C, which the rig names, found those of a HDL-32E; give the file of this "
        "lidar, or correct the model",
    ),
    "angles of another vendor": (
        "xt16_bare/drive.pcap --metadata files/rs16.csv",
        1,
        "xt16_bare/drive.pcap: 10.0.0.8 > port 2368 carries HESAI lidar PandarXT-16, strongest "
        "return; expected metadata that match, found only rs16.csv; give the sensor's with "
        "--metadata FILE" + HESAI,
    ),
    "angles of another vendor in the rig": (
        "xt16_bare/drive.pcap --rig rs16_csv.yaml",
        1,
        "rs16_csv.yaml: sensor top: expected packets that match files/rs16.csv, found HESAI lidar "
        "PandarXT-16, strongest return (10.0.0.8 > port 2368); correct model, stream or metadata",
    ),
    "angles of two units that fit alike": (
        "xt16_alike/drive.pcap",
        1,
        "packets of 10.0.0.8 > port 2368 (568 bytes) carry no serial number and match 2 metadata "
        "files: xt16_alike/a.csv, xt16_alike/b.csv; expected one; name the sensor of each source "
        "with stream.source_ip in a rig file (--rig), or give only its --metadata",
    ),
    "broken angles next to the recording": (
        "xt16_broken/drive.pcap",
        1,
        "xt16_broken/drive.pcap: 10.0.0.8 > port 2368 carries HESAI lidar PandarXT-16, strongest "
        "return; expected metadata that match, found only 16.csv; give the sensor's with "
        "--metadata FILE (xt16_broken/16.csv: HESAI angles, line 2: expected azimuth from -360 to "
        "360 deg, found zero; read the correction file from the lidar again)" + HESAI,
    ),
    "broken angles": (
        "xt16_broken/drive.pcap --metadata xt16_broken/16.csv",
        1,
        "xt16_broken/16.csv: HESAI angles, line 2: expected azimuth from -360 to 360 deg, found "
        "zero; read the correction file from the lidar again",
    ),
    "angles of one for two lidars": (
        "xt16_twins/drive.pcap",
        1,
        "metadata xt16_twins/16.csv matches the packets of 2 streams (10.0.0.8 > port 2368; "
        "10.0.0.9 > port 2368), which carry no serial number; expected a metadata file each; name "
        "them in a rig file (--rig) with stream.source_ip",
    ),
    "angles of one for two lidars in the rig": (
        "xt16_twins/drive.pcap --rig xt16_csv.yaml",
        1,
        "xt16_csv.yaml: sensor top: expected packets of one lidar, found those of several "
        "(PandarXT-16) on 10.0.0.8 > port 2368, 10.0.0.9 > port 2368; name its stream (source_ip, "
        "port, topic or serial)",
    ),
    "model of the rig without its angles": (
        "xt16_bare/drive.pcap --rig xt16.yaml",
        1,
        "xt16.yaml: sensor top: expected metadata that match HESAI lidar PandarXT-16, strongest "
        "return (10.0.0.8 > port 2368), found none; give them as `metadata:` of the sensor, or "
        "with --metadata",
    ),
    "ROBOSENSE without device packets": (
        "helios_bare/drive.pcap",
        1,
        "helios_bare/drive.pcap: 10.0.0.8 > port 6699: ROBOSENSE Helios 16: expected the angles of "
        "its channels, found no DIFOP packets; record its device port (7788) as well, or give a "
        "csv of `elevation,azimuth` lines with --metadata",
    ),
    "ROBOSENSE angles of too few lines": (
        "helios_bare/drive.pcap --metadata files/rs15.csv",
        1,
        "files/rs15.csv: ROBOSENSE angles: expected 16, 32, 48, 80, 96 or 128 lines "
        "`elevation,azimuth`, found 15; give a line for each channel of the sensor",
    ),
    "ROBOSENSE angles of another model": (
        "helios_bare/drive.pcap --metadata files/rs32.csv",
        1,
        "helios_bare/drive.pcap: 10.0.0.8 > port 6699: ROBOSENSE Helios 16: expected the angles "
        "of its channels, found no DIFOP packets; record its device port (7788) as well, or give "
        "a csv of `elevation,azimuth` lines with --metadata (without a match: rs32.csv)",
    ),
    "serial number of another ROBOSENSE": (
        "helios/drive.pcap --rig serial.yaml",
        1,
        "serial.yaml: sensor top: expected packets of serial number 77, found those of "
        "0a1b2c3d4e5f; correct the serial",
    ),
    "serial number of a ROBOSENSE without device packets": (
        "helios_bare/drive.pcap --rig serial.yaml",
        1,
        "serial.yaml: sensor top: ROBOSENSE Helios 16: expected the angles of its channels, found "
        "no DIFOP packets; record its device port (7788) as well, or give a csv of "
        "`elevation,azimuth` lines with --metadata",
    ),
    "another model of ROBOSENSE": (
        "helios/drive.pcap --rig helios32.yaml",
        1,
        "helios32.yaml: sensor top: its packets are ROBOSENSE lidar Helios 16, single return, not "
        "Helios 32, as which they were read: ROBOSENSE Helios 32: expected the angles of its "
        "channels, found DIFOP packets without angles; record its device port (7788) as well, or "
        "give a csv of `elevation,azimuth` lines with --metadata",
    ),
    "HDL-64E without its file": (
        "hdl64/drive.pcap",
        1,
        "hdl64/drive.pcap: 10.0.0.8 > port 2368: HDL-64E: expected its calibration, found none; "
        "give the unit's YAML or db.xml with --metadata or as `metadata:` in the rig",
    ),
    "HDL-64E of a rig without its file": (
        "hdl64/drive.pcap --rig any.yaml",
        1,
        "any.yaml: sensor top: HDL-64E: expected its calibration, found none; give the unit's YAML "
        "or db.xml with --metadata or as `metadata:` in the rig",
    ),
    "HDL-64E with another file": (
        "hdl64/drive.pcap --metadata files/vlp16.yml",
        1,
        "hdl64/drive.pcap: 10.0.0.8 > port 2368: HDL-64E: expected its calibration, found none; "
        "give the unit's YAML or db.xml with --metadata or as `metadata:` in the rig (without a "
        "match: vlp16.yml)",
    ),
    "strict with the file of another Velodyne": (
        "vlp32c/drive.pcap --metadata files/vlp16.yml --strict",
        1,
        "files/vlp16.yml: expected a sensor that it matches, found none; it is not used; leave it "
        "out, or name its sensor in a rig file (--rig) (calibration, an error because of --strict)",
    ),
    "file of another Velodyne in the rig": (
        "vlp16/drive.pcap --rig vlp32c_yml.yaml",
        1,
        "vlp32c_yml.yaml: sensor top: expected packets that match files/vlp32c.yml, found "
        "Velodyne lidar VLP-16, strongest return (10.0.0.8 > port 2368); correct model, stream or "
        "metadata",
    ),
    "file of a Velodyne that is cut off": (
        "vlp16/drive.pcap --metadata files/cut.yml",
        1,
        "files/cut.yml: lasers: expected 16, 32, 64, 128 lasers, found 3 (Velodyne calibration); "
        "use the vendor's file of this sensor",
    ),
    "model in small letters": (
        "vlp16/drive.pcap --rig small.yaml",
        1,
        "small.yaml: sensor top: expected a supported model, found 'vls-128'; did you mean "
        "VLS-128?",
    ),
    "misspelt model": (
        "vlp16/drive.pcap --rig vlp61.yaml",
        1,
        "vlp61.yaml: sensor top: expected a supported model, found 'VLP-61'; did you mean VLP-16?",
    ),
    "another model of Velodyne": (
        "vlp16/drive.pcap --rig vlp32c.yaml",
        1,
        "vlp32c.yaml: sensor top: expected packets of the model VLP-32C, found those of VLP-16; "
        "correct model, stream or metadata",
    ),
    "model of another vendor": (
        "vlp16/drive.pcap --rig xt16.yaml",
        1,
        "xt16.yaml: sensor top: expected packets of the model PandarXT-16, found those of VLP-16; "
        "correct model, stream or metadata",
    ),
    "model of a third vendor": (
        "vlp16/drive.pcap --rig os1.yaml",
        1,
        "os1.yaml: sensor top: expected packets of the model OS1-32, found those of VLP-16; "
        "correct model, stream or metadata",
    ),
    "model of Livox": (
        "vlp16/drive.pcap --rig livox.yaml",
        1,
        "livox.yaml: sensor top: expected packets of the model Livox SDK2, found those of VLP-16; "
        "correct model, stream or metadata",
    ),
    "model of a lidar that needs no file": (
        "xt16_bare/drive.pcap --rig vlp16.yaml",
        1,
        "vlp16.yaml: sensor top: expected packets of the model VLP-16, found HESAI lidar "
        "PandarXT-16, strongest return (10.0.0.8 > port 2368); correct model, stream or metadata",
    ),
    "file of another vendor in the rig": (
        "vlp16/drive.pcap --rig xt16_csv.yaml",
        1,
        "xt16_csv.yaml: sensor top: expected packets that match files/xt16.csv, found Velodyne "
        "lidar VLP-16, strongest return (10.0.0.8 > port 2368); correct model, stream or metadata",
    ),
    "silent lidar of unknown model": (
        "silent/drive.pcap --rig silent.yaml",
        1,
        "silent.yaml: sensor top: expected a packet of it (source_ip 10.0.0.8) in the first 10 "
        "seconds, found none to decide its model; correct its stream, or give `metadata:` or "
        "`model:`",
    ),
    "silent HESAI": (
        "silent/drive.pcap --rig silent_csv.yaml",
        1,
        "silent_csv.yaml: sensor top: files/xt16.csv: HESAI angles: expected packets of the lidar "
        "in the first 10 seconds, which define its model and mode, found none; check its stream in "
        "the rig file, or leave it out",
    ),
    "silent ROBOSENSE": (
        "silent/drive.pcap --rig silent_helios.yaml",
        1,
        "silent_helios.yaml: sensor top: ROBOSENSE Helios 16: expected packets in the first 10 "
        "seconds, which define its return mode, found none; correct its stream, or leave it out of "
        "the rig",
    ),
    "silent Livox": (
        "silent/drive.pcap --rig silent_livox.yaml",
        1,
        "silent_livox.yaml: sensor top: Livox SDK2: expected packets of points in the first 10 "
        "seconds, which define the kind, found none; check the sensor's stream in the rig file, or "
        "leave it out",
    ),
    "decoder option with another value": (
        "vlp16/drive.pcap --decode firing_azimuth=maybe",
        2,
        "--decode firing_azimuth: expected on or off, found 'maybe'; write --decode "
        "firing_azimuth=on",
    ),
    "unknown decoder option": (
        "vlp16/drive.pcap --decode nonsense=1",
        2,
        "--decode: expected one of crc, firing_azimuth, optical_centre, packet_stamp, "
        "range_unit, vertical_offset, found 'nonsense'; write --decode crc=check",
    ),
    "decoder option of the rig": (
        "vlp16/drive.pcap --rig firing.yaml",
        1,
        "firing.yaml: --decode firing_azimuth=maybe: expected firing_azimuth=on or "
        "firing_azimuth=off, found maybe",
    ),
    "counters 20 minutes apart": (
        "apart/drive.pcap",
        1,
        "clocks of the sensors cannot be compared: expected at most 1 s between them, found "
        "1200.000 s: stamp minus receive time is -0.000 s for velodyne_1 and +1200.000 s for "
        "velodyne_2; use --align-clocks or --clock host, or give clock.offset_s or clock.epoch in "
        "the rig",
    ),
    "counter since power-on and a clock": (
        "livox/drive.pcap --identity-extrinsics",
        1,
        "clocks of the sensors cannot be compared: expected at most 1 s between them, found "
        "1699998999.999 s: stamp minus receive time is -0.001 s for ouster_111 and "
        "-1699999000.000 s for livox_1; use --align-clocks or --clock host, or give clock.offset_s "
        "or clock.epoch in the rig",
    ),
    "two Velodynes without extrinsics": (
        "twins/drive.pcap",
        1,
        "extrinsics unknown for velodyne_1, velodyne_2; required for every sensor when there are "
        "two or more; give them in a rig file (--rig), /tf_static or metadata (ouster-sdk "
        "extrinsic), or accept the body origin with --identity-extrinsics",
    ),
    "lidars of two vendors without extrinsics": (
        "pair/drive.pcap",
        1,
        "extrinsics unknown for ouster_111, velodyne_1; required for every sensor when there are "
        "two or more; give them in a rig file (--rig), /tf_static or metadata (ouster-sdk "
        "extrinsic), or accept the body origin with --identity-extrinsics",
    ),
    "one of two Velodynes": (
        "twins/drive.pcap --rig any.yaml",
        1,
        "any.yaml: sensor top: expected packets of one lidar, found those of several (VLP-16) on "
        "10.0.0.8 > port 2368, 10.0.0.9 > port 2368; name its stream (source_ip, port, topic or "
        "serial)",
    ),
    "one of two vendors": (
        "pair/drive.pcap --rig any.yaml",
        1,
        "any.yaml: sensor top: expected packets of one lidar, found those of several (OS-1-16, "
        "VLP-16) on 10.0.0.1 > port 7502, 10.0.0.8 > port 2368; name its stream (source_ip, port, "
        "topic or serial)",
    ),
    "two of a rig that name no streams": (
        "twins/drive.pcap --rig two.yaml",
        1,
        "two.yaml: sensor front: expected packets of one lidar, found those of several (VLP-16) "
        "on 10.0.0.8 > port 2368, 10.0.0.9 > port 2368; name its stream (source_ip, port, topic "
        "or serial)",
    ),
    "two of a rig on one stream": (
        "vlp16/drive.pcap --rig same.yaml",
        1,
        "same.yaml: sensors front and rear: expected a stream each, found 10.0.0.8 > port 2368 "
        "for both; name the stream of each (source_ip, port, topic or serial)",
    ),
    "look-alike": (
        "alike/drive.pcap",
        1,
        "alike/drive.pcap: no lidar packets; expected raw UDP packets of a supported lidar (see "
        "`mlbatch sensors`), found 10.0.0.8 > port 2368 (1212 bytes: LSLIDAR-like, 1212 bytes: "
        "not supported); check that the recording contains the sensor's data port",
    ),
    "position packets only": (
        "positions/drive.pcap",
        1,
        "positions/drive.pcap: no lidar packets; expected raw UDP packets of a supported lidar "
        "(see `mlbatch sensors`), found 10.0.0.8 > port 8308 (512 bytes: Velodyne position "
        "packet); check that the recording contains the sensor's data port",
    ),
    "device packets only": (
        "difop/drive.pcap",
        1,
        "difop/drive.pcap: no lidar packets; expected raw UDP packets of a supported lidar (see "
        "`mlbatch sensors`), found 10.0.0.8 > port 7788 (1248 bytes: ROBOSENSE DIFOP packet); "
        "check that the recording contains the sensor's data port",
    ),
    "GPS packets only": (
        "gps/drive.pcap",
        1,
        "gps/drive.pcap: no lidar packets; expected raw UDP packets of a supported lidar (see "
        "`mlbatch sensors`), found 10.0.0.8 > port 10110 (512 bytes: HESAI GPS packet); check "
        "that the recording contains the sensor's data port",
    ),
    "strict with a change of the return mode": (
        "changed/drive.pcap --strict",
        1,
        "sensor velodyne_1: expected no rejected packet because of --strict, found 400 rejected "
        "as bad_header; leave --strict out to count them instead",
    ),
    "strict with packets of two sizes": (
        "p40/drive.pcap --strict",
        1,
        "10.0.0.8 > port 2368: expected packets of 1262 bytes as at first, found 1266 bytes as "
        "well, which are rejected as bad_size; split the recording where the settings of the "
        "lidar change (calibration, an error because of --strict)",
    ),
    "metadata is a folder": (
        "vlp16/drive.pcap --metadata files",
        1,
        "files: expected a calibration file, found a folder; check the path",
    ),
    "metadata of clouds": (
        "clouds.db3 --rig cloud_csv.yaml",
        1,
        "cloud_csv.yaml: sensor top: expected packets that match files/xt16.csv, found lidar "
        "points of a PointCloud2, every point is a column (/points); correct model, stream or "
        "metadata",
    ),
    "strict with metadata of clouds": (
        "clouds.db3 --metadata files/xt16.csv --strict",
        1,
        "files/xt16.csv: expected a sensor that it matches, found none; it is not used; leave it "
        "out, or name its sensor in a rig file (--rig) (calibration, an error because of --strict)",
    ),
}
