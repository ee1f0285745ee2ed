"""Real recordings against digests: bytes of scans, tables and reports stay what they were.

`digests.json` holds the start of a SHA-256 for each. To write it again, after a change that is
meant:

    python -m tests.recordings.test_digests --write
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.builders.run import command
from tests.golden.digest_outputs import Digests
from tests.recordings import RECORDINGS

_DIGESTS = Path(__file__).with_name("digests.json")
_WINDOWS: Mapping[str, tuple[str, ...]] = {
    "10 Hz": (),
    "100 Hz": ("--rate", "100"),
    "10 slices": ("--slices", "10"),
}
_FORMATS = ("mcap", "ply", "npz")
# The clocks of these pairs count from power-on.
_OPTIONS: Mapping[str, tuple[str, ...]] = {
    "ouster/two-sensors_same-ports_legacy": ("--align-clocks",),
    "ouster/two-sensors_same-ports_nonlegacy": ("--align-clocks",),
}
RECORDED = (
    "hesai/pandar40p",
    "hesai/pandar64",
    "hesai/pandar64_all-points",
    "hesai/pandarqt64",
    "hesai/pandarxt16",
    "hesai/pandarxt32",
    "ouster/os0-128_512x10_crc",
    "ouster/os0-128_v2.3.0_rng15",
    "ouster/os0-128_windowed",
    "ouster/os0-32_v2.2.0_rng19-dual",
    "ouster/os0-32_v2.2.0_single-packet",
    "ouster/os1-128_v2.3.0_rng15_3frames",
    "ouster/os1-32-g_v2.1.1_legacy",
    "ouster/os1-64_fw1_legacy_broadcast",
    "ouster/os1-64_fw2.0_legacy_reduced-config",
    "ouster/os2-128_duplicate-ip-id",
    "ouster/two-sensors_same-ports_legacy",
    "ouster/two-sensors_same-ports_nonlegacy",
    "velodyne/hdl32e_named-vlp32",
    "velodyne/vlp16_azimuth-36000",
    "velodyne/vlp16_gps",
    "velodyne/vlp16_ros2_dual",
    "velodyne/vlp16_wrong-product-byte",
    "velodyne/vlp32c_ros2",
)


def _recording(name: str) -> Path:
    """The capture, or the folder of the bag, in the folder of a recording."""
    folder = RECORDINGS / name
    (path,) = [*folder.glob("*.pcap"), *(one.parent for one in folder.rglob("*.db3"))]
    return path


def _digests(name: str, kind: str, windows: str, folder: Path) -> dict[str, str]:
    """Digest of the scans, of scans.csv and of the report."""
    out = folder / f"out.{kind}" if kind == "mcap" else folder / "out"
    result = command(
        "convert",
        _recording(name),
        "-o",
        out,
        *("--format", kind, "--identity-extrinsics", "--keep-partial", "--quiet"),
        *_WINDOWS[windows],
        *_OPTIONS.get(name, ()),
    )
    assert result.code == 0, result.err
    digests = Digests()
    digests.add_folder(folder)
    tables = {name for name in digests.product if name.endswith("scans.csv")}
    report = {key: value for key, value in digests.context.items() if not key.endswith(" inputs")}
    parts: dict[str, Mapping[str, str]] = {
        "scans": {key: digests.product[key] for key in digests.product.keys() - tables},
        "table": {key: digests.product[key] for key in tables},
        "report": report,
    }
    return {
        part: hashlib.sha256(json.dumps(sorted(values.items())).encode()).hexdigest()[:16]
        for part, values in parts.items()
    }


@pytest.mark.parametrize("windows", _WINDOWS)
@pytest.mark.parametrize("kind", _FORMATS)
@pytest.mark.parametrize("name", RECORDED)
def test_bytes_are_those_of_before(name: str, kind: str, windows: str, tmp_path: Path) -> None:
    expected = json.loads(_DIGESTS.read_text("utf-8"))[f"{name} {kind} {windows}"]
    assert _digests(name, kind, windows, tmp_path) == expected


def _write() -> None:
    found = {}
    for name in RECORDED:
        for kind in _FORMATS:
            for windows in _WINDOWS:
                with tempfile.TemporaryDirectory() as folder:
                    key = f"{name} {kind} {windows}"
                    found[key] = _digests(name, kind, windows, Path(folder))
    _DIGESTS.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", "utf-8")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--write", action="store_true", required=True)
    arguments.parse_args()
    _write()
