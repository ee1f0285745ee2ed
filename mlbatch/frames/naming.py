"""Names that drivers and people give to the frames of sensors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from mlbatch.arrays import F64Array
from mlbatch.frames.tree import clean


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A frame that may be a sensor's; lower ranks are tried first.

    sensor_from_frame: (4, 4), where the frame is not the one points are in; None where it is.
    """

    frame: str
    rank: int = 0
    sensor_from_frame: F64Array | None = None


@dataclass(frozen=True, slots=True)
class Naming:
    """What a maker's driver calls its frames.

    points: frames that points are in; lidar: frames turned against it as the metadata say; nick:
    words that people add to the place to name a whole sensor.
    """

    points: tuple[str, ...]
    lidar: tuple[str, ...] = ()
    nick: tuple[str, ...] = ("lidar",)


# Points of an Ouster leave our decoder in os_sensor: its lidar-to-sensor transform is applied.
# `left_lidar` could be either of its frames, so `lidar` is no nick of an Ouster.
NAMINGS: Mapping[str, Naming] = {
    "ouster": Naming(("os_sensor",), ("os_lidar",), ("os", "ouster")),
    "velodyne": Naming(("velodyne",), nick=("velodyne", "lidar")),
    "hesai": Naming(("hesai_lidar", "hesai", "pandar"), nick=("hesai", "pandar", "lidar")),
    "robosense": Naming(("rslidar",), nick=("rslidar", "robosense", "lidar")),
}
_OTHER = Naming(("lidar",))
# p: place of the sensor, such as left; n: nick; f: the driver's own name of the frame.
OWN_PATTERNS = ("{p}/{f}", "{p}_{f}", "{f}_{p}", "{n}_{p}/{f}", "{n}_{p}_{f}")
WHOLE_PATTERNS = ("{p}", "{n}_{p}", "{p}_{n}")
# Parts of topics that say what a sensor is, not where.
GENERIC = (
    *("ouster", "os", "os_node", "os1_node", "os_cloud_node", "velodyne", "hesai", "pandar"),
    *("robosense", "rslidar", "sensing", "sensor", "sensors", "lidar", "lidars", "driver"),
)
# Ranks: the kind of a frame first, then how closely its place is the sensor's.
_KINDS = ("stated", "points", "lidar", "whole")
_CLOSENESS = ("namespace", "place", "word", "plain")


def candidates(
    maker: str,
    places: Sequence[str],
    *,
    alone: bool,
    frame_id: str = "",
    sensor_from_lidar: F64Array | None = None,
) -> tuple[Candidate, ...]:
    """Frames that may be those of a sensor, by what is known of it.

    places: topics of its packets, or its name in the rig; alone: no other sensor of this maker;
    frame_id: as its own messages state it; sensor_from_lidar: (4, 4), metres, of its metadata.
    """
    naming = NAMINGS.get(maker.lower(), _OTHER)
    found: dict[str, Candidate] = {}
    if clean(frame_id):
        found[clean(frame_id)] = Candidate(clean(frame_id), _rank("stated", "plain"))
    kinds: list[tuple[str, Sequence[str], F64Array | None]] = [("points", naming.points, None)]
    if sensor_from_lidar is not None:
        kinds.append(("lidar", naming.lidar, sensor_from_lidar))
    steps = list(_places(places, naming.nick))
    for kind, frames, correction in kinds:
        for closeness, place in [*steps, *([("plain", "")] if alone else [])]:
            for frame in _names(OWN_PATTERNS if place else ("{f}",), place, naming.nick, frames):
                rank = _rank(kind, closeness)
                found.setdefault(frame, Candidate(frame, rank, correction))
    for closeness, place in steps:
        for frame in _names(WHOLE_PATTERNS, place, naming.nick, ("",)):
            found.setdefault(frame, Candidate(frame, _rank("whole", closeness)))
    return tuple(sorted(found.values(), key=lambda one: one.rank))


def named_frame(frame: str, among: Sequence[Candidate]) -> Candidate:
    """The frame that a rig names for a sensor whose candidates are `among`."""
    name = clean(frame)
    turned = any(word in name for naming in NAMINGS.values() for word in naming.lidar)
    corrections = (one.sensor_from_frame for one in among if one.sensor_from_frame is not None)
    return Candidate(name, 0, next(corrections, None) if turned else None)


def _rank(kind: str, closeness: str) -> int:
    return len(_CLOSENESS) * _KINDS.index(kind) + _CLOSENESS.index(closeness)


def _names(
    patterns: Sequence[str], place: str, nicks: Sequence[str], frames: Sequence[str]
) -> Iterator[str]:
    for pattern in patterns:
        for nick in nicks:
            for frame in frames:
                yield pattern.format(p=place, n=nick, f=frame)


def _places(places: Sequence[str], nicks: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Words for where a sensor sits, with how close they are to its own namespace."""
    for text in places:
        parts = namespace(text) if "/" in text else [text]
        if parts:
            yield "namespace", "/".join(parts)
        telling = [part for part in parts if part not in GENERIC]
        if telling:
            yield "place", "/".join(telling)
            yield "place", "_".join(telling)
            yield "word", telling[-1]
            for nick in nicks:
                yield "word", telling[-1].removeprefix(f"{nick}_").removesuffix(f"_{nick}")


def namespace(topic: str) -> list[str]:
    """Parts of a topic before its last one."""
    return [part for part in topic.split("/") if part][:-1]


def same_namespace(topic_a: str, topic_b: str) -> bool:
    """Whether two topics differ in their last part only, as those of one driver do."""
    return namespace(topic_a) == namespace(topic_b)


def nearest_topic(topic: str, others: Iterable[str]) -> str | None:
    """The topic that shares the longest namespace with `topic`; None if none or several do.

    One of the two namespaces must hold the other: /left and /right of one car are not related.
    """
    own, shared = namespace(topic), dict[int, list[str]]()
    for other in others:
        theirs = namespace(other)
        common = min(len(own), len(theirs))
        if own[:common] == theirs[:common] and (common or own == theirs):
            # The same namespace is closer than any part of it.
            shared.setdefault(2 * common + (own == theirs), []).append(other)
    best = shared[max(shared)] if shared else []
    return best[0] if len(best) == 1 else None
