"""Encoders against bytes, times and rays worked out by hand from docs/sources.

Bytes of HESAI families are laid out by hand for the decoder (`hesai/test_points.py`), which
`test_round_trip.py` compares with the encoders; beams and firing times: `test_documents.py`.
"""

from __future__ import annotations

from datetime import datetime

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.simulate.velodyne.encode import VelodyneSpec, gprmc
from tests.builders.others import rows


def counted(spec: VelodyneSpec, packets: int) -> U8Array:
    """Payloads: distance 256 x column + laser + 1 (return 1: 32768 more), level: the laser's id."""
    columns, lasers, _ = spec.shape(packets)
    column = np.arange(columns)[:, None, None]
    laser = np.arange(lasers)[:, None]
    distance = 256 * column + laser + 1 + 32768 * np.arange(spec.returns)
    return rows(
        [one.payload for one in spec.encode(distance, np.broadcast_to(laser, distance.shape))]
    )


def check_bytes(payload: U8Array, expected: str) -> None:
    """expected: place and bytes, again and again."""
    words = expected.split()
    for at, text in zip(map(int, words[::2]), words[1::2], strict=True):
        assert (at, payload[at : at + len(text) // 2].tobytes().hex()) == (at, text)


# 600 rpm are 0.36 hundredths of a degree a microsecond.
@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        # Block 0: lasers 0 and 1 of column 0, laser 0 of column 1; block 1: 39.81 -> 40.
        (VelodyneSpec("VLP-16"), "0 ffee0000010000020001 52 010100 100 ffee2800010200"),
        # Blocks 0 and 1 are two returns of columns 0 and 1, block 2 the next pair.
        (VelodyneSpec("VLP-16", "dual"), "0 ffee0000010000 100 ffee0000018000 200 ffee2800010200"),
        # 35990 = 8c96; 36029.81 - 36000 -> 30.
        (
            VelodyneSpec("Puck Hi-Res", "last", start_azimuth_deg=359.9),
            "0 ffee968c010000 97 10010f 100 ffee1e00 1204 3824",
        ),
        # 46.08 us -> 16.59 -> 17; laser 31 is the last of a block.
        (VelodyneSpec("HDL-32E"), "0 ffee0000010000 97 20001f 100 ffee1100010100 1204 3721"),
        (VelodyneSpec("HDL-32E", "dual"), "100 ffee0000018000 200 ffee1100010100 1204 3921"),
        # 55.296 us -> 19.91 -> 20, eleven of them 218.97 -> 219.
        (VelodyneSpec("VLP-32C"), "0 ffee0000010000 100 ffee1400010100 1100 ffeedb00 1204 3728"),
        (VelodyneSpec("VLP-32C", "dual"), "100 ffee0000018000 200 ffee1400010100 1204 3928"),
        # Four banks of one azimuth; 55.277 us -> 19.90 -> 20.
        (
            VelodyneSpec("VLS-128"),
            "0 ffee0000010000 100 ffdd0000210020 200 ffcc0000410040 300 ffbb0000610060 "
            "400 ffee1400010100 1204 37a1",
        ),
        (
            VelodyneSpec("VLS-128", "dual"),
            "0 ffee0000010000 100 ffee0000018000 200 ffdd0000210020 700 ffbb0000618060 "
            f"800 {'00' * 400} 1204 39a1",
        ),
        # 48 us -> 17.28 -> 17; the last two bytes are a status: "H", 0.
        (
            VelodyneSpec("HDL-64E S2"),
            "0 ffee0000010000 100 ffdd0000210020 200 ffee1100010100 1204 4800",
        ),
        # 57.6 us -> 20.74 -> 21; both blocks of a return come together.
        (
            VelodyneSpec("HDL-64E S3", "dual"),
            "0 ffee0000010000 100 ffdd0000210020 200 ffee0000018000 300 ffdd0000218020 "
            "400 ffee1500010100",
        ),
        # Row 905 is the first at or past 270 degrees: 89.9 + 905 x 0.1990656 = 270.0544.
        (
            VelodyneSpec("VLP-32C", start_azimuth_deg=89.9, blind_deg=(90, 270)),
            "0 ffee1e23 100 ffee7d69",
        ),
    ],
)
def test_bytes_of_a_velodyne(spec: VelodyneSpec, expected: str) -> None:
    payload = counted(spec, 1)[0]
    assert payload.shape == (1206,)
    check_bytes(payload, expected)


@pytest.mark.parametrize(
    ("spec", "first_us", "second_us"),
    [
        (VelodyneSpec("VLP-16"), 1_000_000, 1_001_327),
        (VelodyneSpec("VLP-16", "dual"), 1_000_000, 1_000_664),
        (VelodyneSpec("Puck Hi-Res"), 1_000_000, 1_001_327),
        (VelodyneSpec("HDL-32E"), 1_000_000, 1_000_553),
        (VelodyneSpec("HDL-32E", stamps_end=True), 1_000_543, 1_001_096),
        (VelodyneSpec("VLP-32C"), 1_000_000, 1_000_664),
        (VelodyneSpec("VLP-32C", "dual"), 1_000_000, 1_000_332),
        # The fourth group is stamped, 8.7 us after the first.
        (VelodyneSpec("VLS-128"), 1_000_009, 1_000_175),
        (VelodyneSpec("VLS-128", sequence_us=53.3), 1_000_009, 1_000_169),
        (VelodyneSpec("HDL-64E S2"), 1_000_000, 1_000_288),
        (VelodyneSpec("HDL-64E S3", "dual"), 1_000_000, 1_000_173),
        (VelodyneSpec("HDL-32E", start_us=3_599_999_999), 3_599_999_999, 552),
        # The second packet begins with row 916, 50 651.136 us after the start.
        (
            VelodyneSpec("VLP-32C", start_azimuth_deg=89.9, blind_deg=(90, 270)),
            *(1_000_000, 1_050_651),
        ),
    ],
)
def test_stamps_of_a_velodyne(spec: VelodyneSpec, first_us: int, second_us: int) -> None:
    stamps_us = counted(spec, 2)[:, 1200:1204].copy().view("<u4")[:, 0]
    assert stamps_us.tolist() == [first_us, second_us]


def test_position_packets() -> None:
    # The example of many NMEA texts, with its checksum.
    expected = b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
    assert gprmc(datetime(1994, 3, 23, 12, 35, 19)) == expected
    spec = VelodyneSpec("VLP-16", hour=10, start_us=3_599_000_000.0)
    sent = rows([spec.device_packet(after_ns) for after_ns in (250_000_000, 1_250_000_000)])
    assert sent.shape == (2, 512)
    # 3 600 000 000 - 750 000 us = d693a400 - 000b71b0, and 250 000 us past the next hour.
    check_bytes(sent[0], "198 503288d602")
    check_bytes(sent[1], "198 90d0030002")
    texts = [payload[206:334].tobytes().rstrip(b"\0") for payload in sent]
    assert texts[0].startswith(b"$GPRMC,105959,A,")
    assert b",010170," in texts[0]
    assert texts[1].startswith(b"$GPRMC,110000,A,")
    assert not any(spec.device_packet(0, pps=0, nmea=False)[202:])
