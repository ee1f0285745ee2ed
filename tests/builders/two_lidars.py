"""The two lidars of `fixtures/two_lidars`: geometry, metadata and packets.

Source: docs/sources/ouster.md sections 1 (metadata), 6 (range to xyz), 8 (IMU). The bytes of the
fixture were laid out by hand; the encoder of simulate must make them again.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.ouster.encode import IntLike, OusterSpec, encode_packets
from tests.builders.scene import Scene

COLUMNS_PER_TURN = 512
COLUMNS_PER_PACKET = 16
BEAMS = 32
MM_PER_M = 1000.0


@dataclass(frozen=True, slots=True)
class FixtureLidar:
    """One lidar: its identity, its pose on the machine, and its measurements.

    altitude_span_deg: of the top beam, the lowest has the same below; offset_mm: distance of the
    beams' origin from the rotor's axis; lift_mm: of the lidar above the sensor frame; range_step_mm
    and near_ir_step: what one count in the packets means; zero_ms: begin of the first revolution,
    after a full second; translation_m, rpy_deg: body_from_sensor.
    """

    name: str
    product: str
    serial: str
    init_id: int
    ip: str
    profile: str
    altitude_span_deg: float
    offset_mm: float
    lift_mm: float
    range_step_mm: int
    near_ir_step: int
    first_frame: int
    zero_ms: int
    turn_ns: int
    translation_m: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]

    @property
    def spec(self) -> OusterSpec:
        """The sensor that its packets are of."""
        return OusterSpec(
            self.profile,
            BEAMS,
            COLUMNS_PER_TURN,
            COLUMNS_PER_PACKET,
            serial=int(self.serial),
            init_id=self.init_id,
        )


# The rotors pass zero 37 ms apart and rotate at slightly different speeds, as real ones do. The
# frame ids of `right` wrap within the recording.
LEFT = FixtureLidar(
    name="left",
    product="OS-0-32-U1",
    serial="122647000123",
    init_id=4660341,
    ip="10.5.5.87",
    profile="RNG19_RFL8_SIG16_NIR16",
    altitude_span_deg=44.5,
    offset_mm=27.67,
    lift_mm=36.18,
    range_step_mm=1,
    near_ir_step=1,
    first_frame=1207,
    zero_ms=-87,
    turn_ns=99_990_000,
    translation_m=(0.3, 0.95, 2.45),
    rpy_deg=(0.4, 22.0, 80.0),
)
RIGHT = FixtureLidar(
    name="right",
    product="OS-1-32-U1",
    serial="122648000456",
    init_id=7713026,
    ip="10.5.5.88",
    profile="RNG15_RFL8_NIR8",
    altitude_span_deg=22.4,
    offset_mm=15.806,
    lift_mm=38.195,
    range_step_mm=8,
    near_ir_step=16,
    first_frame=65532,
    zero_ms=-50,
    turn_ns=100_010_000,
    translation_m=(0.28, -0.9, 2.4),
    rpy_deg=(-0.6, 20.5, -78.0),
)


def altitude_deg(lidar: FixtureLidar) -> list[float]:
    """Beams from the top down, not quite evenly, as calibration gives them."""
    step = 2 * lidar.altitude_span_deg / (BEAMS - 1)
    return [
        round(lidar.altitude_span_deg - beam * step + 0.03 * (beam * 7 % 5 - 2), 2)
        for beam in range(BEAMS)
    ]


def azimuth_deg(lidar: FixtureLidar) -> list[float]:
    """Azimuth offsets in the usual pattern of four."""
    pattern = (4.21, 1.39, -1.41, -4.23)
    return [round(pattern[beam % 4] + 0.01 * (beam * 3 % 7), 2) for beam in range(BEAMS)]


def pose(translation_m: Sequence[float], rpy_deg: Sequence[float]) -> F64Array:
    """(4, 4) by rotations about the fixed axes x, y, z; metres (docs/rig.md)."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.radians(rpy_deg)) for f in (np.cos, np.sin))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    matrix[:3, 3] = translation_m
    return matrix


def body_from_sensor(lidar: FixtureLidar) -> F64Array:
    """Extrinsics."""
    return pose(lidar.translation_m, lidar.rpy_deg)


def rays(lidar: FixtureLidar) -> tuple[F64Array, F64Array]:
    """Origins, unit directions (columns x beams, 3) of a revolution, m, body frame; section 6."""
    theta = 2 * math.pi * (1 - np.arange(COLUMNS_PER_TURN)[:, None] / COLUMNS_PER_TURN)
    turned = theta - np.radians(azimuth_deg(lidar))
    altitude = np.radians(altitude_deg(lidar))
    direction = np.stack(
        [
            np.cos(turned) * np.cos(altitude),
            np.sin(turned) * np.cos(altitude),
            np.broadcast_to(np.sin(altitude), turned.shape),
        ],
        axis=-1,
    )
    # Lidar to sensor frame: half a revolution about z, and the lift.
    half_revolution = np.array([-1.0, -1.0, 1.0])
    offset_m = lidar.offset_mm / MM_PER_M
    lift_m = lidar.lift_mm / MM_PER_M
    origin = np.zeros_like(direction)
    origin[..., 0] = offset_m * np.cos(theta)
    origin[..., 1] = offset_m * np.sin(theta)
    matrix = body_from_sensor(lidar)
    sensor_origin = origin * half_revolution + (0.0, 0.0, lift_m)
    return (
        (sensor_origin @ matrix[:3, :3].T + matrix[:3, 3]).reshape(-1, 3),
        (direction * half_revolution @ matrix[:3, :3].T).reshape(-1, 3),
    )


def turn_fields(lidar: FixtureLidar, scene: Scene) -> dict[str, I64Array]:
    """Fields (columns, beams) of any revolution, as nothing moves; range 0 where nothing is hit."""
    origins, directions = rays(lidar)
    distance_m = scene.cast(origins, directions)
    surface = scene.surface_hit(origins, directions)
    hit = surface >= 0
    brightness = np.array([surface.reflectivity for surface in scene.surfaces] + [0])[surface]
    # The sensor counts the range from the rotor's axis, along the beam.
    range_mm = np.where(hit, distance_m * MM_PER_M + lidar.offset_mm, 0.0)
    nearest_m = np.where(hit, np.maximum(distance_m, 1.0), 1.0)
    near_ir = np.where(hit, 320, 2400) // lidar.near_ir_step * lidar.near_ir_step
    fields = {
        "RANGE": np.round(range_mm / lidar.range_step_mm) * lidar.range_step_mm,
        "REFLECTIVITY": brightness,
        "NEAR_IR": near_ir,
    }
    if lidar.range_step_mm == 1:
        fields["SIGNAL"] = np.round(brightness * 200 / nearest_m**2)
    shape = COLUMNS_PER_TURN, BEAMS
    return {name: values.astype(np.int64).reshape(shape) for name, values in fields.items()}


def column_stamps(lidar: FixtureLidar, second_ns: int, turns: int) -> I64Array:
    """Timestamps (turns x columns,), ns, from `zero_ms` after a full second; steps of 10 ns."""
    column = np.arange(turns * COLUMNS_PER_TURN, dtype=np.int64)
    stamps = second_ns + lidar.zero_ms * 1_000_000 + column * lidar.turn_ns // COLUMNS_PER_TURN
    return stamps // 10 * 10


def packets(lidar: FixtureLidar, fields: Mapping[str, I64Array], stamp_ns: I64Array) -> list[bytes]:
    """Lidar packets of columns from measurement id 0 on."""
    number = np.arange(len(stamp_ns))
    mids = number % COLUMNS_PER_TURN
    frames = (lidar.first_frame + number // COLUMNS_PER_TURN) % 65536
    values: dict[str, IntLike] = {name: one[mids] for name, one in fields.items()}
    return encode_packets(lidar.spec, stamp_ns, mids, frames, values)


def imu_packet(lidar: FixtureLidar, stamp_ns: int) -> bytes:
    """A legacy IMU packet of the machine at rest: 1 g upward, no rotation (section 8)."""
    up_g = body_from_sensor(lidar)[:3, :3].T @ (0.0, 0.0, 1.0)
    return struct.pack("<3Q6f", stamp_ns, stamp_ns, stamp_ns, *up_g, 0.0, 0.0, 0.0)


def metadata(lidar: FixtureLidar) -> dict[str, object]:
    """The metadata document, nested shape (section 1)."""
    lift = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, lidar.lift_mm, 0, 0, 0, 1]
    imu = [1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1]
    beam = [1, 0, 0, lidar.offset_mm, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    return {
        "sensor_info": {
            "prod_line": lidar.product,
            "prod_sn": lidar.serial,
            "initialization_id": lidar.init_id,
            "build_rev": "v2.5.3",
            "status": "RUNNING",
        },
        "lidar_data_format": {
            "columns_per_frame": COLUMNS_PER_TURN,
            "columns_per_packet": COLUMNS_PER_PACKET,
            "pixels_per_column": BEAMS,
            "column_window": [0, COLUMNS_PER_TURN - 1],
            "pixel_shift_by_row": [
                round(angle * COLUMNS_PER_TURN / 360) for angle in azimuth_deg(lidar)
            ],
            "udp_profile_lidar": lidar.profile,
            "udp_profile_imu": "LEGACY",
        },
        "config_params": {
            "lidar_mode": f"{COLUMNS_PER_TURN}x10",
            "timestamp_mode": "TIME_FROM_SYNC_PULSE_IN",
            "multipurpose_io_mode": "INPUT_NMEA_UART",
            "nmea_leap_seconds": 0,
            "phase_lock_enable": False,
            "udp_dest": "10.5.5.1",
            "udp_port_lidar": 7502,
            "udp_port_imu": 7503,
            "udp_profile_lidar": lidar.profile,
            "udp_profile_imu": "LEGACY",
        },
        "beam_intrinsics": {
            "lidar_origin_to_beam_origin_mm": lidar.offset_mm,
            "beam_to_lidar_transform": beam,
            "beam_altitude_angles": altitude_deg(lidar),
            "beam_azimuth_angles": azimuth_deg(lidar),
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": lift},
        "imu_intrinsics": {"imu_to_sensor_transform": imu},
    }
