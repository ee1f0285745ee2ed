"""Extrinsics of the sensors of a session, from sources in order of trust.

The order: rig, /tf_static, constant /tf, fixed joints of the URDF, metadata. The first source with
an answer is used; a warning names others that differ from it. Transforms and joints form one tree
of frames, so that a chain may pass through edges of several sources; what is ambiguous is not used.
Sources: docs/sources/messages.md sections 2 and 6.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn, TypeAlias

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.discovery.types import DetectedSensor, Note, Pose
from mlbatch.errors import RigError
from mlbatch.frames.naming import Candidate, candidates, named_frame
from mlbatch.frames.transforms import compose, inverse
from mlbatch.frames.tree import Chain, Edge, FrameTree, clean, difference, edge_of, some
from mlbatch.lidar.limits import FAR_POSE_M, MAX_TRANSLATION_M
from mlbatch.rig.recipes import FOLDER
from mlbatch.rig.rig import DEFAULT_BODY_FRAME, Rig, UnknownExtrinsics
from mlbatch.types import Stream, StreamTable
from mlbatch.units import MM_PER_M, RAD_PER_DEG

# Parent, child, translation x, y, z in metres, quaternion x, y, z, w.
Transform: TypeAlias = tuple[str, str, Sequence[float], Sequence[float]]
# Of a rig: (4, 4) body_from_sensor, m, or the name of a frame of the recording, or unknown.
RigExtrinsics: TypeAlias = F64Array | str | UnknownExtrinsics
# Sources whose edges form the tree, in order of trust.
TREE_SOURCES = ("tf_static", "tf", "urdf")
# Poses farther apart contradict each other.
MAX_APART_M = 1e-3
MAX_APART_RAD = 0.1 * RAD_PER_DEG
# Angles of mounts are multiples of this, where they are round.
_EIGHTH_RAD = math.pi / 4
# Sources print their numbers with different digits; a difference at the bound is accepted.
_ROUNDING = 1e-9


class Extrinsics(NamedTuple):
    """Poses of all sensors of a session in one body frame, warnings, and all static frames."""

    body_frame: str
    poses: dict[str, Pose]
    notes: tuple[Note, ...]
    tree: FrameTree


@dataclass(slots=True)
class _TfTransform:
    """A transform of /tf: its first value, and whether all others are equal."""

    first: Transform
    count: int = 0
    is_constant: bool = True


class ExtrinsicsSources:
    """Transforms and robot descriptions of a session; `resolve` gives the poses of its sensors."""

    def __init__(self) -> None:
        self._static = FrameTree()
        self._urdf = FrameTree()
        self._tf: dict[tuple[str, str], _TfTransform] = {}
        # By child frame: why an edge is not used.
        self._unused: dict[str, str] = {}
        self._notes: list[Note] = []

    def add_transforms(
        self, source: Literal["tf_static", "tf"], transforms: Iterable[Transform]
    ) -> None:
        """Add the transforms of one message; in /tf_static the last one of a child is used."""
        for parent, child, translation_m, xyzw in transforms:
            transform = (clean(parent), clean(child), tuple(translation_m), tuple(xyzw))
            if source == "tf_static":
                self._add_edge(self._static, transform, source)
                continue
            known = self._tf.setdefault(transform[:2], _TfTransform(transform))
            known.count += 1
            known.is_constant &= known.first == transform

    def add_urdf(self, text: str) -> None:
        """Add the fixed joints of a robot description; an unreadable one gives a warning."""
        # Few recordings have one.
        from mlbatch.frames.urdf import joints

        try:
            for joint in joints(text):
                parent = clean(joint.parent)
                child = clean(joint.child)
                if joint.is_fixed:
                    self._urdf.add(Edge(parent, child, joint.matrix, "urdf"))
                else:
                    self._unused[child] = (
                        f"joint {joint.name} ({parent} -> {child}) of the URDF is not fixed but "
                        f"{joint.kind or 'without a type'}"
                    )
        except RigError as err:
            self._notes.append(Note("urdf", "", str(err)))

    def resolve(
        self,
        sensor_frames: Mapping[str, Sequence[Candidate]],
        rig_extrinsics: Mapping[str, RigExtrinsics],
        metadata_extrinsics: Mapping[str, F64Array],
        body_frame: str | None,
        *,
        identity_extrinsics: bool = False,
    ) -> Extrinsics:
        """Poses of all sensors; RigError if one of several sensors has no extrinsics.

        sensor_frames: by sensor, frames it may have; metadata_extrinsics: (4, 4) body_from_sensor,
        m; body_frame: that of the rig; identity_extrinsics: sensors without extrinsics are at the
        body origin.
        """
        trees = self._trees()
        named = {name: frame for name, frame in rig_extrinsics.items() if isinstance(frame, str)}
        sensor_frames = {
            name: [named_frame(named[name], frames)] if name in named else frames
            for name, frames in sensor_frames.items()
        }
        tree = FrameTree.merged(trees.values())
        finder = _FrameFinder(tree, sensor_frames, self._unused)
        found = finder.best() if body_frame is None else finder.under(clean(body_frame))
        for name, frame in named.items():
            if name not in found.poses:
                _refuse_frame(name, clean(frame), tree, found.reasons)
        poses: dict[str, Pose] = {}
        notes = list(self._notes)
        for name in sensor_frames:
            answers = _answers(name, rig_extrinsics, found, metadata_extrinsics)
            poses[name] = answers[0] if answers else Pose.identity()
            _refuse_far(name, poses[name])
            if answers:
                others = [*answers[1:], *_poses_by_source(name, found, trees)]
                notes += dict.fromkeys(_contradictions(name, poses[name], others))
                notes += self._constant_tf(name, poses[name])
            if name in found.reasons and poses[name].source != "rig":
                notes.append(_note("extrinsics_frame", name, found.reasons[name]))
        missing = [name for name, pose in poses.items() if not pose.is_known]
        unknown = {
            name: one.place
            for name, one in rig_extrinsics.items()
            if isinstance(one, UnknownExtrinsics)
        }
        if len(poses) > 1 and not identity_extrinsics:
            if unknown:
                _refuse_unknown_in_rig(unknown, poses)
            if missing:
                _refuse_unknown(missing, found.reasons)
        if missing and identity_extrinsics and (len(poses) > 1 or unknown):
            notes.append(_not_placed(missing))
        notes += _same_poses(poses)
        notes += _far_poses(poses)
        if unknown and missing and not identity_extrinsics:
            # A single sensor: no frame of the rig describes its points.
            body_frame = missing[0]
        body = body_frame or _body_frame(poses, found.body)
        if body_frame is None:
            notes += _assumed_frames(poses, body)
        return Extrinsics(body, poses, tuple(notes), tree)

    def _add_edge(self, tree: FrameTree, transform: Transform, source: str) -> None:
        try:
            tree.add(edge_of(*transform, source))
        except RigError as err:
            self._unused[transform[1]] = str(err)

    def _trees(self) -> dict[str, FrameTree]:
        """Edges of every source, in order of trust; of /tf only edges that never changed."""
        constant = FrameTree()
        for (parent, child), transform in self._tf.items():
            if transform.is_constant:
                self._add_edge(constant, transform.first, "tf")
            else:
                self._unused[child] = f"/tf changes {parent} -> {child} during the recording"
        return {"tf_static": self._static, "tf": constant, "urdf": self._urdf}

    def _constant_tf(self, name: str, pose: Pose) -> Iterator[Note]:
        """Warnings about edges of /tf, which is for moving frames, used as static ones."""
        for edge in () if pose.chain is None else pose.chain.edges:
            if edge.source == "tf":
                count = self._tf[edge.parent, edge.child].count
                text = f"/tf never changed {edge} in {count} message(s): used as static"
                yield _note("constant_tf", name, text)


def place(
    sensors: Sequence[DetectedSensor],
    sources: ExtrinsicsSources,
    table: StreamTable,
    rig: Rig | None,
    *,
    frames: Mapping[Stream, str] | None = None,
    calibration_topics: Collection[str] = (),
    identity_extrinsics: bool,
) -> Extrinsics:
    """Set the poses of all sensors; RigError if one of several sensors has no extrinsics.

    frames: frame_id of the points of streams, where their messages name one; calibration_topics:
    topics with calibrations of sensors.
    """
    vendors = Counter(sensor.lidar.vendor for sensor in sensors)
    known_frames = {
        sensor.name: _stated(table, sensor, frames or {})
        or candidates(
            sensor.lidar.vendor,
            _places(table, sensor, calibration_topics),
            alone=vendors[sensor.lidar.vendor] == 1,
            sensor_from_lidar=sensor.lidar.sensor_from_lidar,
        )
        for sensor in sensors
    }
    by_rig = {
        sensor.name: sensor.rig.extrinsics
        for sensor in sensors
        if sensor.rig is not None and sensor.rig.extrinsics is not None
    }
    by_metadata = {
        sensor.name: sensor.lidar.extrinsics
        for sensor in sensors
        if sensor.lidar.extrinsics is not None
    }
    body_frame = None if rig is None else rig.body_frame
    extrinsics = sources.resolve(
        known_frames, by_rig, by_metadata, body_frame, identity_extrinsics=identity_extrinsics
    )
    for sensor in sensors:
        sensor.pose = extrinsics.poses[sensor.name]
    return extrinsics._replace(notes=(*extrinsics.notes, *_radians(sensors)))


def _stated(
    table: StreamTable, sensor: DetectedSensor, frames: Mapping[Stream, str]
) -> tuple[Candidate, ...]:
    """The frame that the messages of a sensor name, which no similar name can replace."""
    named = {clean(frames.get(table.streams[stream], "")) for stream in sensor.streams} - {""}
    return tuple(Candidate(frame) for frame in sorted(named))


def _places(
    table: StreamTable, sensor: DetectedSensor, calibration_topics: Collection[str]
) -> list[str]:
    """Topics of a sensor's packets, else of its calibration, else its name: the base of frames."""
    topics = sorted({table.streams[stream].topic for stream in sensor.streams} - {""})
    if not topics and sensor.lidar.calibration in calibration_topics:
        topics = [sensor.lidar.calibration]
    return topics or [sensor.name]


# -- frames of the tree ---------------------------------------------------------------------------


@dataclass(slots=True)
class _FramesFound:
    """Frames of sensors under a body frame."""

    body: str = ""
    frames: dict[str, Candidate] = field(default_factory=dict)
    poses: dict[str, Pose] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)  # why the other sensors have none


class _FrameFinder(NamedTuple):
    """Finds the frames of sensors in a tree."""

    tree: FrameTree
    candidates: Mapping[str, Sequence[Candidate]]  # by sensor
    unused: Mapping[str, str]  # by child frame, why an edge is missing in the tree

    def best(self) -> _FramesFound:
        """Frames under base_link if it is above all of them, else under their common ancestor."""
        found = self._under_a_root()
        frames = [one.frame for one in found.frames.values()]
        base = DEFAULT_BODY_FRAME
        if frames and base in self.tree and self.tree.ancestor([base, *frames]) == base:
            return self.under(base)
        # A single frame is its own ancestor, and no body frame.
        shared = self.tree.ancestor(frames) if len(frames) > 1 else None
        if shared is not None:
            return self.under(shared)
        text = "no frame of another sensor is connected with its own"
        alone = dict.fromkeys(found.poses, text) if len(self.candidates) > 1 else {}
        return _FramesFound(reasons=found.reasons | alone)

    def under(self, body: str) -> _FramesFound:
        """Frames that are connected with `body`, each of one sensor only."""
        found = _FramesFound(body)
        for name in self.candidates:
            self._find(name, found)
        owners = Counter(one.frame for one in found.frames.values())
        for name, candidate in list(found.frames.items()):
            count = owners[candidate.frame]
            if count > 1:
                del found.frames[name]
                del found.poses[name]
                found.reasons[name] = f"frame {candidate.frame} could be that of {count} sensors"
        return found

    def _under_a_root(self) -> _FramesFound:
        """Frames under the root that most sensors are connected with."""
        tree = self.tree
        frames = [one.frame for candidates in self.candidates.values() for one in candidates]
        roots = sorted({tree.top(frame)[0] for frame in frames if frame in tree})
        results = [self.under(root) for root in roots or [""]]
        most = max(len(found.poses) for found in results)
        best = [found for found in results if len(found.poses) == most]
        if len(best) > 1 and DEFAULT_BODY_FRAME in tree:
            root = tree.top(DEFAULT_BODY_FRAME)[0]
            best = [found for found in best if found.body == root] or best
        if len(best) == 1 or len(self.candidates) == 1:
            return best[0]
        text = f"nothing connects the frames {' and '.join(one.body for one in best)}"
        return _FramesFound(reasons=dict.fromkeys(self.candidates, text))

    def _find(self, name: str, found: _FramesFound) -> None:
        """Find the frame of one sensor: the connected one of lowest rank, if it is unambiguous."""
        connected: list[tuple[Candidate, Pose]] = []
        reasons: dict[str, None] = {}
        known = [one for one in self.candidates[name] if one.frame in self.tree]
        for candidate in sorted(known, key=lambda one: one.rank):
            try:
                chain = self.tree.chain(found.body, candidate.frame)
            except RigError as err:
                reasons[str(err)] = None
                continue
            if chain is not None:
                connected.append((candidate, _tree_pose(chain, candidate)))
                continue
            why = self.unused.get(self.tree.top(candidate.frame)[0], "")
            text = f"nothing connects frame {candidate.frame} with {found.body}"
            reasons[f"{text}: {why}" if why else text] = None
        if not connected:
            if reasons:
                found.reasons[name] = "; ".join(reasons)
            elif self.tree.frames:
                frames = some(self.tree.frames)
                own = self.candidates[name]
                found.reasons[name] = (
                    f"its points are in frame {own[0].frame}, which is none of the recording's "
                    f"({frames})"
                    if len(own) == 1
                    else f"none of the recording's frames ({frames}) is named as its driver would "
                    "name it"
                )
            return
        best, pose = connected[0]
        for other, other_pose in connected[1:]:
            if other.rank == best.rank and _gap(pose, other_pose):
                found.reasons[name] = f"frames {best.frame} and {other.frame} could both be its own"
                return
        found.frames[name] = best
        found.poses[name] = pose


def _tree_pose(chain: Chain, candidate: Candidate) -> Pose:
    """Pose of a sensor by its chain; points are in the sensor frame, not in the lidar frame."""
    matrix = chain.matrix
    if candidate.sensor_from_frame is not None:
        matrix = compose(matrix, inverse(candidate.sensor_from_frame))
    return Pose(matrix, _chain_sources(chain)[-1], chain)


def _chain_sources(chain: Chain) -> list[str]:
    """Sources of the edges of a chain, most trusted first."""
    used = {edge.source for edge in chain.edges}
    # Without edges the body frame is the sensor's own, which any source may name.
    return [source for source in TREE_SOURCES if source in used] or [TREE_SOURCES[0]]


# -- answers of the sources -----------------------------------------------------------------------


def _answers(
    name: str,
    rig: Mapping[str, RigExtrinsics],
    found: _FramesFound,
    metadata: Mapping[str, F64Array],
) -> list[Pose]:
    """Poses of a sensor by rig, tree and metadata: in order of trust."""
    answers = []
    by_rig = rig.get(name)
    if isinstance(by_rig, np.ndarray):
        answers.append(Pose(by_rig, "rig"))
    if name in found.poses:
        answers.append(found.poses[name])
    if name in metadata:
        answers.append(Pose(metadata[name], "metadata"))
    return answers


def _poses_by_source(
    name: str, found: _FramesFound, trees: Mapping[str, FrameTree]
) -> Iterator[Pose]:
    """Poses of a sensor if each source of the tree were the most trusted one."""
    if name not in found.frames:
        return
    candidate = found.frames[name]
    for source, tree in trees.items():
        others = [other for other in trees.values() if other is not tree]
        try:
            chain = FrameTree.merged([tree, *others]).chain(found.body, candidate.frame)
        except RigError:
            continue
        if chain is not None and any(edge.source == source for edge in chain.edges):
            yield _tree_pose(chain, candidate)._replace(source=source)


def _contradictions(name: str, used: Pose, others: Iterable[Pose]) -> Iterator[Note]:
    """Warnings about poses that differ from the one that is used."""
    for other in others:
        gap = _gap(used, other)
        if gap:
            source = used.source
            if used.chain is not None and other.source == source:
                source = _chain_sources(used.chain)[0]
            chain = used.chain or other.chain
            text = (
                f"its extrinsics of {source} and of {other.source} differ by {gap}"
                f"{'' if chain is None else f' ({chain})'}; {source} is used, correct the wrong one"
            )
            yield _note("extrinsics_contradict", name, text)


def _gap(one: Pose, other: Pose) -> str:
    """Difference of two poses as text; "" if it is tolerable."""
    apart_m, apart_rad = difference(one.body_from_sensor, other.body_from_sensor)
    if apart_m <= MAX_APART_M + _ROUNDING and apart_rad <= MAX_APART_RAD + _ROUNDING:
        return ""
    return f"{apart_m * MM_PER_M:.1f} mm and {apart_rad / RAD_PER_DEG:.2f} degrees"


def _same_poses(poses: Mapping[str, Pose]) -> Iterator[Note]:
    """Warnings about sensors at the pose of an earlier one; not where no source gives a pose.

    The body origin is then accepted by the user.
    """
    known = [(name, pose) for name, pose in poses.items() if pose.is_known]
    for number, (name, pose) in enumerate(known):
        for other, other_pose in known[:number]:
            if not _gap(other_pose, pose):
                text = (
                    f"expected a pose of its own, found that of {other} ({pose.source}); correct "
                    "its extrinsics, or leave out those of both and give --identity-extrinsics if "
                    "their points are in the body frame already"
                )
                yield _note("same_pose", name, text)
                break


def _not_placed(missing: Sequence[str]) -> Note:
    """The warning that sensors are at the body origin because no source says where they are."""
    noun = "sensor" if len(missing) == 1 else "sensors"
    text = (
        f"{noun} {', '.join(missing)}: expected extrinsics, found none: at the body origin by "
        "--identity-extrinsics, clouds fit together only if their points are in the body frame "
        "already; else give the poses in a rig file (--rig)"
    )
    return Note("identity_extrinsics", missing[0] if len(missing) == 1 else "", text)


def _far_poses(poses: Mapping[str, Pose]) -> Iterator[Note]:
    """Warnings about sensors that are too far from the body origin for a vehicle."""
    for name, pose in poses.items():
        away_m = float(np.linalg.norm(pose.body_from_sensor[:3, 3]))
        if away_m > FAR_POSE_M:
            text = (
                f"expected at most {FAR_POSE_M:g} m from the body origin, found {away_m:.6g} m "
                f"({pose.describe()}): as millimetres this would be {away_m / MM_PER_M:.4g} m; "
                "give metres, from an origin on the vehicle"
            )
            yield _note("far_pose", name, text)


def _radians(sensors: Sequence[DetectedSensor]) -> Iterator[Note]:
    """Warnings about angles of the rig that are round in radians, not in degrees."""
    for sensor in sensors:
        angles = () if sensor.rig is None else sensor.rig.rotation_rpy_deg
        if not any(map(_is_round_in_radians, angles)) or max(map(abs, angles)) > math.pi + 0.01:
            continue
        as_given = ", ".join(f"{angle:g}" for angle in angles)
        turned = ", ".join(f"{angle / RAD_PER_DEG:.4g}" for angle in angles)
        text = (
            f"rotation_rpy_deg: expected degrees, found [{as_given}], which is less than 4 degrees "
            f"as read, and [{turned}] degrees if it was meant as radians; write degrees, or give "
            "such a small rotation as rotation_xyzw"
        )
        yield _note("radians", sensor.name, text)


def _is_round_in_radians(angle: float) -> bool:
    """True for a multiple of pi / 4 to all decimals given, at least two."""
    exponent = Decimal(repr(angle)).as_tuple().exponent
    if not isinstance(exponent, int) or exponent > -2:
        return False
    nearest = round(angle / _EIGHTH_RAD) * _EIGHTH_RAD
    return nearest != 0 and abs(angle - nearest) <= 10.0**exponent


def _assumed_frames(poses: Mapping[str, Pose], body: str) -> Iterator[Note]:
    """Warnings where metadata, which do not name their body frame, are used with a tree."""
    if any(pose.source in TREE_SOURCES for pose in poses.values()):
        for name, pose in poses.items():
            if pose.source == "metadata":
                text = f"the extrinsics of its metadata are assumed to refer to frame {body}"
                yield _note("extrinsics_mixed", name, text)


def _body_frame(poses: Mapping[str, Pose], tree_body: str) -> str:
    """Body frame without a rig: of the tree, else base_link; own frame of an unplaced sensor."""
    if any(pose.source in TREE_SOURCES for pose in poses.values()):
        return tree_body
    if len(poses) == 1:
        ((name, pose),) = poses.items()
        return DEFAULT_BODY_FRAME if pose.is_known else name
    return DEFAULT_BODY_FRAME


def _note(code: str, name: str, text: str) -> Note:
    return Note(code, name, f"sensor {name}: {text}")


def _refuse_frame(name: str, frame: str, tree: FrameTree, reasons: Mapping[str, str]) -> NoReturn:
    """Raise RigError for a frame of the rig without a chain."""
    if not tree.frames:
        raise RigError(
            f"sensor {name}: extrinsics by frame ({frame}) need a recording "
            "with /tf_static, which captures do not have; give translation_m and a rotation"
        )
    reason = reasons[name] if frame in tree and name in reasons else tree.unknown(frame)
    remedy = "correct it, or give translation_m and a rotation"
    raise RigError(f"sensor {name}: extrinsics by frame ({frame}): {reason}; {remedy}")


def _refuse_unknown_in_rig(unknown: Mapping[str, str], poses: Mapping[str, Pose]) -> NoReturn:
    """Raise RigError for `extrinsics: unknown`; unknown: place in the rig file, by sensor."""
    (name, place), *others = unknown.items()
    also = f" (also of {', '.join(other for other, _ in others)})" if others else ""
    remedy = (
        "give translation_m and a rotation (a guess is enough for `mlbatch calibrate`, which "
        "refines it)"
    )
    if place.startswith(str(FOLDER)):
        recipe = Path(place.partition(".yaml")[0]).name
        remedy += f" in a copy of the recipe: mlbatch datasets {recipe} > rig.yaml, --rig rig.yaml"
    if poses[name].is_known:
        remedy = f"remove the key to use that of {poses[name].describe()}"
    raise RigError(
        f"{place}: expected the pose of {name}, required for every sensor when there are two or "
        f"more, found unknown{also}; {remedy}, or accept the body origin with "
        "--identity-extrinsics"
    )


def _refuse_far(name: str, pose: Pose) -> None:
    """Raise RigError for a sensor too far from the body: its float32 coordinates would be wrong."""
    away_m = float(np.abs(pose.body_from_sensor[:3, 3]).max())
    if not away_m <= MAX_TRANSLATION_M:
        raise RigError(
            f"sensor {name}: extrinsics of {pose.describe()}: expected at most "
            f"{MAX_TRANSLATION_M:g} m from the body origin, found {away_m:g} m; give metres in the "
            "body frame in a rig file (--rig)"
        )


def _refuse_unknown(missing: Sequence[str], reasons: Mapping[str, str]) -> NoReturn:
    known = [f"{name}: {reasons[name]}" for name in missing if name in reasons]
    raise RigError(
        f"extrinsics unknown for {', '.join(missing)}; required for every sensor when there are "
        "two or more; give them in a rig file (--rig), /tf_static or metadata (ouster-sdk "
        "extrinsic), measure them by mlbatch calibrate (without a guess: --from-motion), or accept "
        "the body origin with --identity-extrinsics" + (f" ({'; '.join(known)})" if known else "")
    )
