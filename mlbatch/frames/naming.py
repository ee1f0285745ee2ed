"""Frame names of the vendors' drivers and of people, and topics of one driver.

Source: docs/sources/messages.md section 6.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from mlbatch.arrays import F64Array
from mlbatch.frames.tree import clean


class Candidate(NamedTuple):
    """A possible frame of a sensor; lower ranks are tried first.

    sensor_from_frame: (4, 4), m, if the frame is not that of the points; else None.
    """

    frame: str
    rank: int = 0
    sensor_from_frame: F64Array | None = None


class Naming(NamedTuple):
    """Frame names of a vendor's driver.

    points: frames of the points; lidar: frames rotated against them by the metadata; nick: words
    that people combine with the place of a sensor to name it.
    """

    points: tuple[str, ...]
    lidar: tuple[str, ...] = ()
    nick: tuple[str, ...] = ("lidar",)


# Decoded points of an Ouster are in os_sensor, as its lidar-to-sensor transform is applied.
# `left_lidar` could be either of its frames: `lidar` is no nick of an Ouster.
NAMINGS: Mapping[str, Naming] = {
    "ouster": Naming(("os_sensor",), ("os_lidar",), ("os", "ouster")),
    "velodyne": Naming(("velodyne",), nick=("velodyne", "lidar")),
    "hesai": Naming(("hesai_lidar", "hesai", "pandar"), nick=("hesai", "pandar", "lidar")),
    "robosense": Naming(("rslidar",), nick=("rslidar", "robosense", "lidar")),
}
_OTHER = Naming(("lidar",))
# p: place of the sensor, as left; n: nick; f: the driver's name of the frame.
OWN_PATTERNS = ("{p}/{f}", "{p}_{f}", "{f}_{p}", "{n}_{p}/{f}", "{n}_{p}_{f}")
WHOLE_PATTERNS = ("{p}", "{n}_{p}", "{p}_{n}")
# Parts of topics that name the kind of a sensor, not its place.
GENERIC = (
    "ouster",
    "os",
    "os_node",
    "os1_node",
    "os_cloud_node",
    "velodyne",
    "hesai",
    "pandar",
    "robosense",
    "rslidar",
    "sensing",
    "sensor",
    "sensors",
    "lidar",
    "lidars",
    "driver",
)
# Ranks: by the kind of a frame, then by the precision of its place.
_KINDS = ("stated", "points", "lidar", "whole")
_CLOSENESS = ("namespace", "place", "word", "plain")


def candidates(
    vendor: str,
    places: Sequence[str],
    *,
    alone: bool,
    frame_id: str = "",
    sensor_from_lidar: F64Array | None = None,
) -> tuple[Candidate, ...]:
    """Return the possible frames of a sensor, the most certain first.

    places: topics of its packets, or its name in the rig; alone: the only sensor of this vendor;
    frame_id: of its own messages; sensor_from_lidar: (4, 4), m, of its metadata.
    """
    naming = NAMINGS.get(vendor.lower(), _OTHER)
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
    """Return the frame that a rig names for a sensor; among: its candidates."""
    name = clean(frame)
    is_lidar = any(word in name for naming in NAMINGS.values() for word in naming.lidar)
    corrections = (one.sensor_from_frame for one in among if one.sensor_from_frame is not None)
    return Candidate(name, 0, next(corrections, None) if is_lidar else None)


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
    """Yield words for the place of a sensor, each with its precision."""
    for text in places:
        parts = namespace(text) if "/" in text else [text]
        if parts:
            yield "namespace", "/".join(parts)
        specific = [part for part in parts if part not in GENERIC]
        if specific:
            yield "place", "/".join(specific)
            yield "place", "_".join(specific)
            yield "word", specific[-1]
            for nick in nicks:
                yield "word", specific[-1].removeprefix(f"{nick}_").removesuffix(f"_{nick}")


def namespace(topic: str) -> list[str]:
    """Return the parts of a topic before its last one."""
    return [part for part in topic.split("/") if part][:-1]


def same_namespace(topic_a: str, topic_b: str) -> bool:
    """Return whether two topics differ only in their last part, like topics of one driver."""
    return namespace(topic_a) == namespace(topic_b)


def nearest_topic(topic: str, others: Iterable[str]) -> str | None:
    """Return the topic that shares the longest namespace with `topic`; None if none or several do.

    One of the two namespaces must contain the other: /left and /right of one car are not related.
    """
    own = namespace(topic)
    shared: dict[int, list[str]] = {}
    for other in others:
        theirs = namespace(other)
        common = min(len(own), len(theirs))
        if own[:common] == theirs[:common] and (common or own == theirs):
            # An equal namespace is nearer than any part of it.
            shared.setdefault(2 * common + (own == theirs), []).append(other)
    best = shared[max(shared)] if shared else []
    return best[0] if len(best) == 1 else None
