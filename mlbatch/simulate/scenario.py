"""Scenario files (`mlbatch.scenario/1`): what they contain, and their defaults.

Format: docs/simulate.md. All units of users are converted here; errors name file, line and key.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.rig.rig import MAX_NAME
from mlbatch.rig.yaml_tree import Node, read_yaml
from mlbatch.simulate.foliage import Crowns
from mlbatch.simulate.forest import CrownPlan, Forest, Row, grown
from mlbatch.simulate.interface import LidarModel, LidarSettings, lidar_models
from mlbatch.simulate.scene import Boxes, Rectangles, Scene, Stems, Swing
from mlbatch.simulate.terrain import Terrain, rough_terrain
from mlbatch.simulate.trajectory import (
    COORDINATES,
    Curve,
    MonotoneCurve,
    Spline,
    Sway,
    Trajectory,
    ground_along,
    path_from_waypoints,
)
from mlbatch.units import NS_PER_S, RAD_PER_DEG

SCHEMA = "mlbatch.scenario/1"
SHIPPED = Path(__file__).parent / "scenarios"
MAX_LIDARS = 16
_NAME = re.compile(rf"[A-Za-z_]\w{{0,{MAX_NAME - 1}}}", re.ASCII)
_TOPIC = re.compile(r"/[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TEXT = re.compile(r"\S(.*\S)?")
_ADDRESS = re.compile(r"\d{1,3}(\.\d{1,3}){3}", re.ASCII)
_DEFAULT_START = "2026-05-04T08:00:00Z"
_MOST_SECONDS = 86_400.0
_MOST_PPM = 1000.0
_MOST_OFFSET_S = 1000.0
_MOST_METRES = 10_000.0
# Cells of a terrain: 16 million take 0.5 GB.
_MOST_CELLS = 2000
DEFAULT_NOISE_M = 0.01
DEFAULT_RANGE_M = 120.0


@dataclass(frozen=True, slots=True)
class Clock:
    """A sensor clock: offset at the start, and drift, against the true time."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """Standard deviations of a sample and constant biases: rad/s and m/s2."""

    gyro_noise: float = 0.002
    accel_noise: float = 0.02
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accel_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class LidarPlan:
    """A lidar of the rig; settings: without the start of its clock.

    noise_m: standard deviation of ranges; divergence_rad: full width at half maximum of a beam's
    Gaussian profile; dropout, loss: shares of returns and of packets that are
    missing; latency_s, jitter_s: from the last shot of a packet to its receive time.
    """

    name: str
    settings: LidarSettings
    body_from_sensor: F64Array
    address: str
    noise_m: float
    divergence_rad: float
    dropout: float
    loss: float
    max_range_m: float
    clock: Clock
    latency_s: float
    jitter_s: float
    imu: ImuErrors


@dataclass(frozen=True, slots=True, eq=False)
class ImuPlan:
    """An IMU on the body; its messages are `sensor_msgs/Imu`."""

    name: str
    topic: str
    rate_hz: float
    body_from_imu: F64Array
    clock: Clock
    errors: ImuErrors


@dataclass(frozen=True, slots=True)
class TruthPlan:
    """Ground truth; topic: `/tf` for transforms, others for nav_msgs/Odometry."""

    rate_hz: float = 100.0
    topic: str = "/tf"
    frame: str = "world"


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """A rig that moves in a scene; start_ns: epoch of its start (true time).

    body: surfaces of the machine itself, body frame.
    """

    name: str
    seed: int
    duration_s: float
    start_ns: int
    body_frame: str
    trajectory: Trajectory
    scene: Scene
    body: Scene | None
    lidars: tuple[LidarPlan, ...]
    imu: ImuPlan | None
    truth: TruthPlan


def shipped() -> tuple[str, ...]:
    """Return the names of the scenarios of the package."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.yaml")))


def read_scenario(
    place: str, *, seed: int | None = None, duration_s: float | None = None
) -> Scenario:
    """Read a scenario file, or one of the package by its name; RigError for the first mistake.

    seed, duration_s: instead of those of the file.
    """
    path = Path(place)
    if place in shipped() and not path.exists():
        path = SHIPPED / f"{place}.yaml"
    elif not path.is_file():
        names = ", ".join(shipped())
        raise RigError(f"{place}: expected a scenario file or one of {names}, found neither")
    return _scenario(read_yaml(path), path.stem, seed, duration_s)


_KEYS = (
    *("schema", "seed", "duration_s", "start", "body_frame", "motion", "scene", "body"),
    *("sensors", "imu", "truth"),
)


def _scenario(root: Node, name: str, seed: int | None, duration_s: float | None) -> Scenario:
    fields = root.fields(_KEYS, required=("schema", "duration_s", "scene", "sensors"))
    fields["schema"].choice((SCHEMA,))
    if seed is None:
        seed = fields["seed"].whole(0, 2**32 - 1) if "seed" in fields else 0
    terrain, level = _terrain(fields["scene"], seed)
    trajectory = _trajectory(fields.get("motion"), terrain)
    own_s = _number(fields["duration_s"], 0.1, _MOST_SECONDS)
    lasts_s = own_s if duration_s is None else duration_s
    if lasts_s > trajectory.end_s and "motion" in fields and _moves(fields["motion"]):
        raise fields["motion"].error(
            f"waypoints for {lasts_s:g} s",
            f"{trajectory.end_s:g} s with the standstill",
            "add waypoints, or shorten the duration",
        )
    start = fields["start"].word("a time", _TEXT) if "start" in fields else _DEFAULT_START
    lidars = _lidars(fields["sensors"])
    return Scenario(
        name=name,
        seed=seed,
        duration_s=lasts_s,
        start_ns=_epoch_ns(fields.get("start"), start),
        body_frame=_word(fields, "body_frame", "base_link", _NAME, "a frame name"),
        trajectory=trajectory,
        scene=_scene(fields["scene"], terrain, level, trajectory, lasts_s, seed),
        body=_body(fields["body"], lidars) if "body" in fields else None,
        lidars=lidars,
        imu=_imu(fields["imu"]) if "imu" in fields else None,
        truth=_truth(fields["truth"]) if "truth" in fields else TruthPlan(),
    )


# -- values ---------------------------------------------------------------------------------------


def _number(node: Node, low: float, high: float) -> float:
    value = node.number()
    if not low <= value <= high:
        raise node.error(f"a number from {low:g} to {high:g}", node.shown, "correct it")
    return value


def _optional(
    fields: Mapping[str, Node], key: str, default: float, low: float, high: float
) -> float:
    return _number(fields[key], low, high) if key in fields else default


def _word(
    fields: Mapping[str, Node], key: str, default: str, pattern: re.Pattern[str], what: str
) -> str:
    return fields[key].word(what, pattern) if key in fields else default


def _vector(node: Node, low: float = -_MOST_METRES) -> tuple[float, float, float]:
    x, y, z = node.numbers(3)
    for item in node.items:
        _number(item, low, _MOST_METRES)
    return x, y, z


def _vectors(fields: Mapping[str, Node], key: str) -> tuple[float, float, float]:
    return _vector(fields[key]) if key in fields else (0.0, 0.0, 0.0)


def _epoch_ns(node: Node | None, text: str) -> int:
    try:
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        moment = None
    if moment is None or not 1970 < moment.year < 2038:
        expected = f"a time as {_DEFAULT_START}, 1971 to 2037"
        if node is None:
            raise RigError(f"start: expected {expected}, found {text!r}")
        raise node.error(expected, node.shown, "write it in this form")
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    since = moment - datetime(1970, 1, 1, tzinfo=timezone.utc)
    return (since.days * 86_400 + since.seconds) * NS_PER_S + since.microseconds * 1000


def _extrinsics(fields: Mapping[str, Node]) -> F64Array:
    if "extrinsics" not in fields:
        return np.eye(4)
    own = fields["extrinsics"].fields(("translation_m", "rotation_rpy_deg"))
    return from_rpy_deg(_vectors(own, "translation_m"), _vectors(own, "rotation_rpy_deg"))


# -- motion ---------------------------------------------------------------------------------------

_MOTION_KEYS = (
    *("standstill_s", "above_ground", "footprint_m", "interpolation", "waypoints", "sway"),
)
_CURVES: dict[str, type[Curve]] = {"spline": Spline, "monotone": MonotoneCurve}
_SWAY_KEYS = ("coordinate", "amplitude", "frequency_hz", "phase_deg")


def _moves(node: Node) -> bool:
    waypoints = node.entries.get("waypoints")
    return waypoints is not None and len(waypoints.items) > 1


def _trajectory(node: Node | None, terrain: Terrain | None) -> Trajectory:
    """Return the motion; none: the body stands at the origin."""
    if node is None:
        return Trajectory(Spline(np.zeros(1), np.zeros((1, 4))))
    fields = node.fields(_MOTION_KEYS)
    standstill_s = _optional(fields, "standstill_s", 0.0, 0.0, _MOST_SECONDS)
    rows = [[0.0] * 4]
    if "waypoints" in fields:
        rows = [_waypoint(item) for item in fields["waypoints"].elements("waypoints")]
    lengths = {len(row) for row in rows}
    if len(lengths) != 1:
        found = "waypoints with and without yaw"
        raise fields["waypoints"].error(
            "waypoints of one length (time, x, y, z or time, x, y, z, yaw)", found, "use one form"
        )
    table = np.array(rows)
    if (np.diff(table[:, 0]) <= 0.0).any() or table[0, 0] != 0.0:
        raise fields["waypoints"].error(
            "times that start at 0 and increase", "others", "sort the waypoints"
        )
    is_above = "above_ground" in fields and fields["above_ground"].flag()
    on_ground = is_above or "footprint_m" in fields
    if on_ground and terrain is None:
        key = "above_ground" if is_above else "footprint_m"
        raise fields[key].error("a scene with terrain", "none", "remove the key")
    if is_above and "footprint_m" in fields:
        raise fields["footprint_m"].error(
            "one of above_ground and footprint_m", "both", "remove above_ground"
        )
    if is_above and terrain is not None:
        table[:, 3] += terrain.height(table[:, 1:3])
    yaw = table[:, 4] * RAD_PER_DEG if table.shape[1] == 5 else None
    sway = (
        [_sway(item) for item in fields["sway"].elements("sinusoids")] if "sway" in fields else []
    )
    kind = fields["interpolation"].choice(tuple(_CURVES)) if "interpolation" in fields else "spline"
    path = path_from_waypoints(table[:, 0], table[:, 1:4], yaw, _CURVES[kind])
    ground = None
    if terrain is not None and "footprint_m" in fields:
        ground = ground_along(path, terrain, _number(fields["footprint_m"], 0.1, 100.0))
    return Trajectory(path, sway, standstill_s, ground)


def _waypoint(node: Node) -> list[float]:
    items = node.elements("numbers: time (s), x, y, z (m) and yaw (deg)")
    if len(items) not in (4, 5):
        raise node.error("time, x, y, z and, for all or none, yaw", node.shown, "give 4 or 5")
    return [_number(item, -_MOST_SECONDS, _MOST_SECONDS) for item in items]


def _sway(node: Node) -> Sway:
    fields = node.fields(_SWAY_KEYS, required=_SWAY_KEYS[:3])
    coordinate = COORDINATES.index(fields["coordinate"].choice(COORDINATES))
    # Metres or degrees.
    amplitude = _number(fields["amplitude"], 0.0, 45.0)
    return Sway(
        coordinate,
        amplitude * (RAD_PER_DEG if coordinate > 2 else 1.0),
        _number(fields["frequency_hz"], 0.0, 50.0),
        _optional(fields, "phase_deg", 0.0, -360.0, 360.0) * RAD_PER_DEG,
    )


# -- scene ----------------------------------------------------------------------------------------

_SCENE_KEYS = ("rectangles", "boxes", "stems", "terrain", "forest")
_RECTANGLE_KEYS = ("corner_m", "along_m", "across_m", "reflectivity")
_BOX_KEYS = ("centre_m", "size_m", "yaw_deg", "velocity_mps", "repeat_s", "reflectivity")
_PART_KEYS = ("centre_m", "size_m", "yaw_deg", "reflectivity", "swing")
_SWING_KEYS = ("pivot_m", "axis", "amplitude_deg", "frequency_hz", "phase_deg")
_STEM_KEYS = ("base_m", "height_m", "radius_m", "top_radius_m", "reflectivity")
_TERRAIN_KEYS = ("half_size_m", "cell_m", "relief_m", "wavelength_m", "reflectivity")
_FOREST_KEYS = (
    *("area_m", "per_hectare", "radius_m", "height_m", "taper", "clearance_m", "reflectivity"),
    "crown",
)
_CROWN_KEYS = ("low_m", "radius_m", "extinction_per_m", "wind", "flutter", "reflectivity")
_WIND_KEYS = ("amplitude_m", "frequency_hz")
_SMALL_M = 1e-3


def _reflectivity(fields: Mapping[str, Node], default: float = 60.0) -> float:
    return _optional(fields, "reflectivity", default, 1.0, 255.0)


def _terrain(node: Node, seed: int) -> tuple[Terrain | None, float]:
    fields = node.fields(_SCENE_KEYS)
    if "terrain" not in fields:
        return None, 0.0
    own = fields["terrain"].fields(_TERRAIN_KEYS, required=("half_size_m", "relief_m"))
    half_m = _number(own["half_size_m"], 1.0, _MOST_METRES)
    cell_m = _optional(own, "cell_m", 1.0, 0.05, 100.0)
    cells = 2.0 * half_m / cell_m
    if abs(cells - round(cells)) > 1e-6 or not 1 <= cells <= _MOST_CELLS:
        expected = f"a half size of 1 to {_MOST_CELLS} half cells"
        raise own["half_size_m"].error(expected, f"{cells:g} of them", "change cell_m")
    relief_m = _number(own["relief_m"], 0.0, 1000.0)
    wavelength_m = _optional(own, "wavelength_m", 20.0, cell_m, _MOST_METRES)
    terrain = rough_terrain(seed, half_m, cell_m, relief_m, wavelength_m)
    return terrain, _reflectivity(own, 30.0)


def _scene(
    node: Node,
    terrain: Terrain | None,
    level: float,
    trajectory: Trajectory,
    duration_s: float,
    seed: int,
) -> Scene:
    fields = node.fields(_SCENE_KEYS)
    kinds: list[Rectangles | Stems | Boxes] = []
    if "rectangles" in fields:
        rows = [_rectangle(item) for item in fields["rectangles"].elements("rectangles")]
        kinds += [Rectangles(*_columns(rows))] if rows else []
    if "boxes" in fields:
        rows = [_box(item) for item in fields["boxes"].elements("boxes")]
        kinds += [Boxes(*_columns(rows))] if rows else []
    stems = [_stem(item) for item in fields["stems"].elements("stems")] if "stems" in fields else []
    leaves: list[Row] = []
    if "forest" in fields:
        path = trajectory.poses(np.arange(0.0, duration_s, 0.5)).position_m
        for number, item in enumerate(fields["forest"].elements("kinds of plants")):
            own_stems, own_leaves = grown(_forest(item), (seed, number), path, terrain)
            stems += own_stems
            leaves += own_leaves
    kinds += [Stems(*_columns(stems))] if stems else []
    if not kinds and not leaves and terrain is None:
        raise node.error("at least one surface", "none", f"add {', '.join(_SCENE_KEYS)}")
    return Scene(tuple(kinds), terrain, level, _foliage(leaves))


def _foliage(rows: Sequence[Row]) -> Crowns | None:
    if not rows:
        return None
    *columns, flutters = _columns(rows)
    return Crowns(*columns, flutters=flutters > 0.0)


def _body(node: Node, lidars: Sequence[LidarPlan]) -> Scene:
    """Return the boxes that move with the rig; a lidar within one would see nothing else."""
    items = node.elements("boxes")
    if not items:
        raise node.error("at least one box", node.shown, "remove the key")
    rows = [_box(item, _PART_KEYS) for item in items]
    swing = Swing(*_columns([_swing(item) for item in items]))
    boxes = Boxes(*_columns(rows), swing=swing if swing.amplitude_rad.any() else None)
    for number, item in enumerate(items):
        for plan in lidars:
            if boxes.contains(number, plan.body_from_sensor[:3, 3]):
                raise item.error("a box without a lidar in it", plan.name, "move one of the two")
    return Scene((boxes,))


def _swing(node: Node) -> Row:
    """Return the values of Swing of a box; without the key, of none."""
    if "swing" not in node.entries:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0, 0.0, 0.0
    fields = node.entries["swing"].fields(_SWING_KEYS, required=_SWING_KEYS[:4])
    axis = "xyz".index(fields["axis"].choice(tuple("xyz")))
    return (
        _vector(fields["pivot_m"]),
        tuple(np.eye(3)[axis]),
        _number(fields["amplitude_deg"], 0.0, 180.0) * RAD_PER_DEG,
        _number(fields["frequency_hz"], 0.0, 50.0),
        _optional(fields, "phase_deg", 0.0, -360.0, 360.0) * RAD_PER_DEG,
    )


def _columns(rows: Sequence[Row]) -> list[F64Array]:
    """Return the columns of rows as arrays."""
    return [np.array(column, np.float64) for column in zip(*rows, strict=True)]


def _rectangle(node: Node) -> tuple[object, ...]:
    fields = node.fields(_RECTANGLE_KEYS, required=_RECTANGLE_KEYS[:3])
    along = np.array(_vector(fields["along_m"]))
    across = np.array(_vector(fields["across_m"]))
    sizes = math.hypot(*along), math.hypot(*across)
    if min(sizes) < _SMALL_M or abs(along @ across) > 1e-6 * sizes[0] * sizes[1]:
        raise fields["across_m"].error(
            "edges at right angles, 1 mm or more", "others", "correct along_m or across_m"
        )
    return _vector(fields["corner_m"]), along, across, _reflectivity(fields)


def _box(node: Node, keys: tuple[str, ...] = _BOX_KEYS) -> tuple[object, ...]:
    fields = node.fields(keys, required=keys[:2])
    return (
        _vector(fields["centre_m"]),
        _vector(fields["size_m"], _SMALL_M),
        _optional(fields, "yaw_deg", 0.0, -360.0, 360.0) * RAD_PER_DEG,
        _vectors(fields, "velocity_mps"),
        _optional(fields, "repeat_s", math.inf, 0.1, _MOST_SECONDS),
        _reflectivity(fields),
    )


def _stem(node: Node) -> tuple[object, ...]:
    fields = node.fields(_STEM_KEYS, required=_STEM_KEYS[:3])
    radius_m = _number(fields["radius_m"], _SMALL_M, 100.0)
    return (
        _vector(fields["base_m"]),
        _number(fields["height_m"], _SMALL_M, 1000.0),
        radius_m,
        _optional(fields, "top_radius_m", radius_m, 0.0, 100.0),
        _reflectivity(fields),
    )


def _forest(node: Node) -> Forest:
    fields = node.fields(_FOREST_KEYS, required=("area_m", "per_hectare", "height_m"))
    if not {"radius_m", "crown"} & set(fields):
        raise node.error("radius_m of stems, crown, or both", "neither", "add one")
    x0, y0, x1, y1 = fields["area_m"].numbers(4)
    if not (x0 < x1 and y0 < y1):
        raise fields["area_m"].error("x0 < x1 and y0 < y1", "others", "swap the corners")
    return Forest(
        (x0, y0, x1, y1),
        _number(fields["per_hectare"], 0.0, 1e5),
        _pair(fields["radius_m"]) if "radius_m" in fields else None,
        _pair(fields["height_m"]),
        _optional(fields, "taper", 1.0, 0.0, 1.0),
        _optional(fields, "clearance_m", 1.5, 0.0, 100.0),
        _reflectivity(fields),
        _crown(fields["crown"]) if "crown" in fields else None,
    )


def _crown(node: Node) -> CrownPlan:
    fields = node.fields(_CROWN_KEYS, required=_CROWN_KEYS[:3])
    wind = fields["wind"].fields(_WIND_KEYS, required=_WIND_KEYS) if "wind" in fields else {}
    still = 0.0, 0.0
    return CrownPlan(
        _pair(fields["low_m"], 0.0),
        _pair(fields["radius_m"]),
        _pair(fields["extinction_per_m"]),
        _pair(wind["amplitude_m"], 0.0) if wind else still,
        _pair(wind["frequency_hz"], 0.0) if wind else still,
        fields["flutter"].flag() if "flutter" in fields else True,
        _reflectivity(fields, 50.0),
    )


def _pair(node: Node, least: float = _SMALL_M) -> tuple[float, float]:
    low, high = node.numbers(2)
    if not least <= low <= high:
        raise node.error("two sizes, the smaller first", f"{low:g} and {high:g}", "swap them")
    return low, high


# -- sensors --------------------------------------------------------------------------------------

_LIDAR_KEYS = (
    *("name", "model", "mode", "rate_hz", "profile", "columns", "phase_deg", "extrinsics"),
    *("address", "serial", "noise_m", "divergence_deg", "dropout", "loss", "max_range_m"),
    *("clock", "latency_s", "jitter_s", "imu"),
)
_ERROR_KEYS = ("gyro_noise", "accel_noise", "gyro_bias", "accel_bias")
_IMU_KEYS = ("name", "topic", "rate_hz", "extrinsics", "clock", *_ERROR_KEYS)


def _lidars(node: Node) -> tuple[LidarPlan, ...]:
    items = node.elements("sensors")
    if not 1 <= len(items) <= MAX_LIDARS:
        raise node.error(f"1 to {MAX_LIDARS} sensors", node.shown, "list each with `- name:`")
    plans = tuple(_lidar(item, number) for number, item in enumerate(items))
    for number, plan in enumerate(plans):
        for other in plans[:number]:
            for key in ("name", "address"):
                if getattr(plan, key) == getattr(other, key):
                    raise items[number].error(
                        f"{'a name' if key == 'name' else 'an address'} of its own",
                        f"{getattr(plan, key)} again",
                        "change one of the two",
                    )
    return plans


def _lidar(node: Node, number: int) -> LidarPlan:
    fields = node.fields(_LIDAR_KEYS, required=("name", "model"))
    model = _model(fields["model"])
    errors = _errors(fields["imu"].fields(_ERROR_KEYS)) if "imu" in fields else None
    settings = LidarSettings(
        model=model.name,
        mode=_one_of(fields, "mode", model.modes),
        rate_hz=int(_one_of(fields, "rate_hz", [str(one) for one in model.rates_hz])),
        profile=_one_of(fields, "profile", model.profiles),
        columns=int(_one_of(fields, "columns", [str(one) for one in model.columns]) or 0),
        phase_deg=_optional(fields, "phase_deg", 0.0, 0.0, 360.0) % 360.0,
        start_ns=0,
        serial=fields["serial"].whole(1, 10**12 - 1) if "serial" in fields else 990_000 + number,
        imu=errors is not None,
    )
    return LidarPlan(
        name=fields["name"].word(f"a name of at most {MAX_NAME} letters, digits and _", _NAME),
        settings=settings,
        body_from_sensor=_extrinsics(fields),
        address=_address(fields, f"10.5.5.{87 + number}"),
        noise_m=_optional(fields, "noise_m", DEFAULT_NOISE_M, 0.0, 10.0),
        divergence_rad=_optional(fields, "divergence_deg", 0.0, 0.0, 5.0) * RAD_PER_DEG,
        dropout=_optional(fields, "dropout", 0.0, 0.0, 1.0),
        loss=_optional(fields, "loss", 0.0, 0.0, 0.99),
        max_range_m=_optional(fields, "max_range_m", DEFAULT_RANGE_M, 1.0, 250.0),
        clock=_clock(fields),
        latency_s=_optional(fields, "latency_s", 3e-4, 0.0, 0.5),
        jitter_s=_optional(fields, "jitter_s", 1e-4, 0.0, 0.5),
        imu=errors or ImuErrors(),
    )


def _model(node: Node) -> LidarModel:
    models = lidar_models()
    name = node.word("a model", _TEXT)
    if name not in models:
        nearest = difflib.get_close_matches(name, models, n=3, cutoff=0.0)
        raise node.error(
            "a model of docs/simulate.md", node.shown, f"the nearest are {', '.join(nearest)}"
        )
    return models[name]


def _one_of(fields: Mapping[str, Node], key: str, choices: Sequence[str]) -> str:
    """Return a value of an option, by default the first; "" for an option without choices."""
    if key not in fields:
        return choices[0] if choices else ""
    if not choices:
        raise fields[key].error(f"no {key} for this model", fields[key].shown, "remove the key")
    return fields[key].choice(choices)


def _address(fields: Mapping[str, Node], default: str) -> str:
    text = _word(fields, "address", default, _ADDRESS, "an IPv4 address")
    if any(int(part) > 255 for part in text.split(".")):
        raise fields["address"].error("an IPv4 address", text, "correct it")
    return text


def _clock(fields: Mapping[str, Node]) -> Clock:
    if "clock" not in fields:
        return Clock()
    own = fields["clock"].fields(("offset_s", "drift_ppm"))
    return Clock(
        _optional(own, "offset_s", 0.0, -_MOST_OFFSET_S, _MOST_OFFSET_S),
        _optional(own, "drift_ppm", 0.0, -_MOST_PPM, _MOST_PPM),
    )


def _errors(fields: Mapping[str, Node]) -> ImuErrors:
    default = ImuErrors()
    return ImuErrors(
        _optional(fields, "gyro_noise", default.gyro_noise, 0.0, 10.0),
        _optional(fields, "accel_noise", default.accel_noise, 0.0, 100.0),
        _vectors(fields, "gyro_bias"),
        _vectors(fields, "accel_bias"),
    )


def _imu(node: Node) -> ImuPlan:
    fields = node.fields(_IMU_KEYS)
    return ImuPlan(
        _word(fields, "name", "imu_link", _NAME, "a frame name"),
        _word(fields, "topic", "/imu/data", _TOPIC, "a topic"),
        _optional(fields, "rate_hz", 100.0, 1.0, 2000.0),
        _extrinsics(fields),
        _clock(fields),
        _errors(fields),
    )


def _truth(node: Node) -> TruthPlan:
    fields = node.fields(("rate_hz", "topic", "frame"))
    return TruthPlan(
        _optional(fields, "rate_hz", 100.0, 1.0, 2000.0),
        _word(fields, "topic", "/tf", _TOPIC, "a topic"),
        _word(fields, "frame", "world", _NAME, "a frame name"),
    )
