"""What a recording says of where its sensors sit: transforms, robot description.

Facts: facts/messages.md sections 2 and 6. Extrinsics in the order rig, /tf_static, constant /tf,
fixed joints of the URDF, metadata; what disagrees is told, what is unclear is not used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.discovery.sampler import Found
from mlbatch.errors import RigError
from mlbatch.frames.naming import Candidate, candidates, named_frame
from mlbatch.frames.transforms import compose, inverse
from mlbatch.frames.tree import Chain, Edge, FrameTree, clean, difference, edge_of, some
from mlbatch.rig.rig import DEFAULT_BODY_FRAME, Rig, RigSensor
from mlbatch.types import StreamTable
from mlbatch.units import MM_PER_M, RAD_PER_DEG

# Parent, child, translation x, y, z in metres, quaternion x, y, z, w.
Stated: TypeAlias = tuple[str, str, Sequence[float], Sequence[float]]
# By sensor: (4, 4) body_from_sensor in metres, or the name of a frame.
Extrinsics: TypeAlias = Mapping[str, F64Array | str]
# In the order in which they are believed.
TREE_SOURCES = ("tf_static", "tf", "urdf")
MAX_APART_M = 1e-3
MAX_APART_RAD = 0.1 * RAD_PER_DEG
# Sources print their numbers with different digits; a difference at the bound is none.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Finding:
    """Something to warn of: a short code, the sensor it is about (or ""), one line."""

    code: str
    sensor: str
    message: str


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Where a sensor sits: (4, 4) body_from_sensor in metres, whose word it is, frames walked.

    source: rig, tf_static, tf, urdf, metadata or identity; a chain over several sources goes by
    the one that is believed least, `leading` by the one believed most. chain: "base_link ->
    os_sensor", "" where none was walked.
    """

    body_from_sensor: F64Array
    source: str
    chain: str = ""
    leading: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """All sensors of a session on their body."""

    body_frame: str
    mounts: dict[str, Mount]
    findings: tuple[Finding, ...]


@dataclass(slots=True)
class _Watched:
    """A transform of /tf as it was first stated, and whether another value ever followed."""

    stated: Stated
    count: int = 0
    is_constant: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _Seat:
    """A frame of the tree in which a sensor sits."""

    candidate: Candidate
    chain: Chain

    @property
    def mount(self) -> Mount:
        """Points are in the sensor frame: what its lidar frame adds is taken off again."""
        matrix, correction = self.chain.matrix, self.candidate.sensor_from_frame
        if correction is not None:
            matrix = compose(matrix, inverse(correction))
        sources = {edge.source for edge in self.chain.edges}
        words = [source for source in TREE_SOURCES if source in sources] or TREE_SOURCES
        # Without edges the body frame is the sensor's own, which any source may have named.
        return Mount(matrix, words[-1] if sources else words[0], str(self.chain), words[0])


@dataclass(slots=True)
class _Search:
    """Seats under a body frame by sensor, and for the others why they have none."""

    body: str = ""
    seats: dict[str, _Seat] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


class Knowledge:
    """Collects what the messages of a session say; `mount` then tells where the sensors sit."""

    def __init__(self) -> None:
        self._static, self._urdf = FrameTree(), FrameTree()
        self._watched: dict[tuple[str, str], _Watched] = {}
        # By child: why a stated edge is not used. Told only to those who miss it.
        self._unused: dict[str, str] = {}
        self._findings: list[Finding] = []

    def add_transforms(self, source: Literal["tf_static", "tf"], edges: Iterable[Stated]) -> None:
        """Add the transforms of one message; in /tf_static the last one of a child counts."""
        for parent, child, translation_m, xyzw in edges:
            stated = (clean(parent), clean(child), tuple(translation_m), tuple(xyzw))
            if source == "tf_static":
                self._add(self._static, stated, source)
                continue
            watched = self._watched.setdefault(stated[:2], _Watched(stated))
            watched.count += 1
            watched.is_constant &= watched.stated == stated

    def add_urdf(self, text: str) -> None:
        """Add the fixed joints of a robot description; one that cannot be read is a finding."""
        # Few recordings have one.
        from mlbatch.frames.urdf import joints

        try:
            for joint in joints(text):
                parent, child = clean(joint.parent), clean(joint.child)
                if joint.is_fixed:
                    self._urdf.add(Edge(parent, child, joint.matrix, "urdf"))
                else:
                    told = f"{joint.name} ({parent} -> {child}) of the URDF is not fixed"
                    self._unused[child] = f"joint {told} but {joint.kind or 'without a type'}"
        except RigError as err:
            self._findings.append(Finding("urdf", "", str(err)))

    def mount(
        self,
        sensor_frames: Mapping[str, Sequence[Candidate]],
        rig_extrinsics: Extrinsics,
        metadata_extrinsics: Mapping[str, F64Array],
        body_frame: str | None,
        *,
        identity_extrinsics: bool = False,
    ) -> Mounting:
        """Place all sensors; RigError if two or more should be, and some have no extrinsics.

        sensor_frames: by sensor, frames it may have (`frames.candidates`); rig_extrinsics: (4, 4)
        or the name of a frame; metadata_extrinsics: (4, 4) body_from_sensor, metres.
        """
        trees = self._all_trees()
        named = {name: frame for name, frame in rig_extrinsics.items() if isinstance(frame, str)}
        wanted = {
            name: [named_frame(named[name], frames)] if name in named else frames
            for name, frames in sensor_frames.items()
        }
        seeker = _Seeker(FrameTree.merged(trees.values()), wanted, self._unused)
        search = seeker.best() if body_frame is None else seeker.under(clean(body_frame))
        for name, frame in named.items():
            if name not in search.seats:
                raise _no_frame(name, clean(frame), seeker.tree, search.reasons)
        told: dict[str, Extrinsics] = {"rig": rig_extrinsics, "metadata": metadata_extrinsics}
        mounts, findings = dict[str, Mount](), list(self._findings)
        for name in sensor_frames:
            options = _options(name, search, told)
            mounts[name] = options[0] if options else Mount(np.eye(4), "identity")
            if options:
                others = [*options[1:], *_other_words(name, search, trees)]
                findings += dict.fromkeys(_contradictions(name, options[0], others))
                findings += self._constants(name, search, options[0])
            if name in search.reasons and mounts[name].source != "rig":
                findings.append(Finding("extrinsics_frame", name, search.reasons[name]))
        missing = [name for name in mounts if mounts[name].source == "identity"]
        if missing and len(mounts) > 1 and not identity_extrinsics:
            raise _refused(missing, search.reasons)
        body = body_frame or _body(mounts, search)
        return Mounting(body, mounts, (*findings, *_mixed(mounts, body_frame, body)))

    def _add(self, tree: FrameTree, stated: Stated, source: str) -> None:
        try:
            tree.add(edge_of(*stated, source))
        except RigError as err:
            self._unused[stated[1]] = str(err)

    def _all_trees(self) -> dict[str, FrameTree]:
        """The edges of every source, those of /tf only where they never changed."""
        constant = FrameTree()
        for (parent, child), watched in self._watched.items():
            if watched.is_constant:
                self._add(constant, watched.stated, "tf")
            else:
                self._unused[child] = f"/tf changes {parent} -> {child} during the recording"
        return dict(zip(TREE_SOURCES, (self._static, constant, self._urdf), strict=True))

    def _constants(self, name: str, search: _Search, mount: Mount) -> Iterator[Finding]:
        """What was taken for static although /tf is for things that move."""
        seat = search.seats.get(name)
        if seat is None or mount.source in ("rig", "metadata"):
            return
        for edge in seat.chain.edges:
            if edge.source == "tf":
                count = self._watched[edge.parent, edge.child].count
                text = f"/tf never changed {edge} in {count} message(s): taken as static"
                yield Finding("constant_tf", name, text)


def _no_frame(name: str, frame: str, tree: FrameTree, reasons: Mapping[str, str]) -> RigError:
    """The error about a frame of the rig that leads nowhere."""
    if not tree.frames:
        return RigError(
            f"sensor {name}: extrinsics by frame ({frame}) need a recording "
            "with /tf_static, which captures do not have; give translation_m and a rotation"
        )
    reason = reasons[name] if frame in tree and name in reasons else tree.unknown(frame)
    remedy = "correct it, or give translation_m and a rotation"
    return RigError(f"sensor {name}: extrinsics by frame ({frame}): {reason}; {remedy}")


@dataclass(frozen=True, slots=True)
class _Seeker:
    """Looks for the sensors' frames in a tree; unused: by child, why an edge is not in it."""

    tree: FrameTree
    wanted: Mapping[str, Sequence[Candidate]]
    unused: Mapping[str, str]

    def best(self) -> _Search:
        """Seats under base_link if all hang on it, else under their nearest common ancestor."""
        found = self._under_a_top()
        frames, base = [one.candidate.frame for one in found.seats.values()], DEFAULT_BODY_FRAME
        if frames and base in self.tree and self.tree.ancestor([base, *frames]) == base:
            return self.under(base)
        # A frame alone is its own ancestor, which says nothing of a body.
        shared = self.tree.ancestor(frames) if len(frames) > 1 else None
        if shared is not None:
            return self.under(shared)
        text = "no frame of another sensor is connected with its own"
        alone = dict.fromkeys(found.seats, text) if len(self.wanted) > 1 else {}
        return _Search(reasons=found.reasons | alone)

    def under(self, body: str) -> _Search:
        """Seats that are connected with `body`; a frame is the seat of one sensor."""
        search = _Search(body)
        for name in self.wanted:
            self._seat(name, search)
        owners = Counter(seat.candidate.frame for seat in search.seats.values())
        for name, seat in list(search.seats.items()):
            frame = seat.candidate.frame
            if owners[frame] > 1:
                del search.seats[name]
                search.reasons[name] = f"frame {frame} could be that of {owners[frame]} sensors"
        return search

    def _under_a_top(self) -> _Search:
        """Seats under the topmost frame that most sensors hang on."""
        tree = self.tree
        frames = [one.frame for among in self.wanted.values() for one in among]
        tops = sorted({tree.top(frame)[0] for frame in frames if frame in tree})
        searches = [self.under(top) for top in tops or [""]]
        most = max(len(search.seats) for search in searches)
        best = [search for search in searches if len(search.seats) == most]
        if len(best) > 1 and DEFAULT_BODY_FRAME in tree:
            home = tree.top(DEFAULT_BODY_FRAME)[0]
            best = [search for search in best if search.body == home] or best
        if len(best) == 1 or len(self.wanted) == 1:
            return best[0]
        text = f"nothing connects the frames {' and '.join(one.body for one in best)}"
        return _Search(reasons=dict.fromkeys(self.wanted, text))

    def _seat(self, name: str, search: _Search) -> None:
        """Find the frame of one sensor; the lowest rank counts, and must be clear."""
        known = [one for one in self.wanted[name] if one.frame in self.tree]
        seats, reasons = list[_Seat](), dict[str, None]()
        for one in sorted(known, key=lambda one: one.rank):
            try:
                chain = self.tree.chain(search.body, one.frame)
            except RigError as err:
                reasons[str(err)] = None
                continue
            if chain is not None:
                seats.append(_Seat(one, chain))
                continue
            why = self.unused.get(self.tree.top(one.frame)[0], "")
            text = f"nothing connects frame {one.frame} with {search.body}"
            reasons[f"{text}: {why}" if why else text] = None
        best = [seat for seat in seats if seat.candidate.rank == seats[0].candidate.rank]
        for other in best[1:]:
            if _gap(best[0].mount, other.mount):
                pair = f"{best[0].candidate.frame} and {other.candidate.frame}"
                search.reasons[name] = f"frames {pair} could both be its own"
                return
        if best:
            search.seats[name] = best[0]
        elif reasons:
            search.reasons[name] = "; ".join(reasons)
        elif self.tree.frames:
            search.reasons[name] = (
                f"none of the recording's frames ({some(self.tree.frames)}) can be told as its own"
            )


def _options(name: str, search: _Search, told: Mapping[str, Extrinsics]) -> list[Mount]:
    """What is known of a sensor's place, the most believed first."""
    rig, metadata = (told[source].get(name) for source in ("rig", "metadata"))
    found = [Mount(rig, "rig")] if isinstance(rig, np.ndarray) else []
    found += [search.seats[name].mount] if name in search.seats else []
    return found + ([Mount(metadata, "metadata")] if isinstance(metadata, np.ndarray) else [])


def _other_words(name: str, search: _Search, trees: Mapping[str, FrameTree]) -> Iterator[Mount]:
    """Where a sensor would sit if each source in turn were believed before all others."""
    seat = search.seats.get(name)
    if seat is None:
        return
    for source, tree in trees.items():
        others = [other for other in trees.values() if other is not tree]
        whole = FrameTree.merged([tree, *others])
        try:
            chain = whole.chain(search.body, seat.candidate.frame)
        except RigError:
            continue
        if chain is not None and any(edge.source == source for edge in chain.edges):
            yield replace(_Seat(seat.candidate, chain).mount, source=source)


def _contradictions(name: str, chosen: Mount, others: Iterable[Mount]) -> Iterator[Finding]:
    for other in others:
        gap = _gap(chosen, other)
        if gap:
            used = chosen.leading if other.source == chosen.source else chosen.source
            chain = chosen.chain or other.chain
            text = (
                f"its extrinsics of {used} and of {other.source} differ by {gap}"
                f"{f' ({chain})' if chain else ''}; {used} is used, correct the wrong one"
            )
            yield Finding("extrinsics_contradict", name, text)


def _gap(first: Mount, second: Mount) -> str:
    """How far two poses are apart, in words; "" if no more than sources may be."""
    apart_m, apart_rad = difference(first.body_from_sensor, second.body_from_sensor)
    if apart_m <= MAX_APART_M + _ROUNDING and apart_rad <= MAX_APART_RAD + _ROUNDING:
        return ""
    return f"{apart_m * MM_PER_M:.1f} mm and {apart_rad / RAD_PER_DEG:.2f} degrees"


def _mixed(mounts: Mapping[str, Mount], given: str | None, body: str) -> Iterator[Finding]:
    """Metadata do not name their body frame; beside a tree it is a guess which one they mean."""
    sources = {mount.source for mount in mounts.values()}
    if given is None and "metadata" in sources and sources.intersection(TREE_SOURCES):
        for name, mount in mounts.items():
            if mount.source == "metadata":
                text = f"the extrinsics of its metadata are taken to be those in frame {body}"
                yield Finding("extrinsics_mixed", name, text)


def _body(mounts: Mapping[str, Mount], search: _Search) -> str:
    """The body frame where nobody names one; a single sensor without a place keeps its own."""
    sources = {mount.source for mount in mounts.values()}
    if sources.intersection(TREE_SOURCES):
        return search.body
    is_alone = sources == {"identity"} and len(mounts) == 1
    return next(iter(mounts)) if is_alone else DEFAULT_BODY_FRAME


def _refused(missing: Sequence[str], reasons: Mapping[str, str]) -> RigError:
    known = [f"{name}: {reasons[name]}" for name in missing if name in reasons]
    return RigError(
        f"extrinsics unknown for {', '.join(missing)}; wanted for every sensor when there are "
        "two or more; give them in a rig file (--rig), /tf_static or metadata (ouster-sdk "
        "extrinsic), or accept the body origin with --identity-extrinsics"
        + (f" ({'; '.join(known)})" if known else "")
    )


# Where the sensors of a session sit on their body, by all that is known.


@dataclass(slots=True)
class Mounted:
    """A sensor with its place on the body and its wishes from the rig (or their defaults).

    extrinsics_source: whose word it is; chain: frames walked from body to sensor, "" where none
    was; offset_ns: added to its stamps.
    """

    found: Found
    body_from_sensor: F64Array
    extrinsics_source: str
    rig: RigSensor | None = None
    chain: str = ""
    offset_ns: int = 0

    @property
    def name(self) -> str:
        """Name in all outputs."""
        return self.found.name

    @property
    def origin(self) -> str:
        """Source and chain in words, as "tf_static: base_link -> left/os_sensor"."""
        return f"{self.extrinsics_source}: {self.chain}" if self.chain else self.extrinsics_source


def mount(
    table: StreamTable,
    found: Sequence[Found],
    rigged: Sequence[RigSensor | None],
    rig: Rig | None,
    knowledge: Knowledge,
    *,
    metadata_topics: Collection[str] = (),
    identity_extrinsics: bool,
) -> tuple[list[Mounted], Mounting]:
    """Place all sensors; RigError where two or more should be, and some have no extrinsics.

    rigged: what the rig says of each sensor, None without a rig; metadata_topics: those that gave
    calibrations.
    """
    makers = Counter(sensor.lidar.maker for sensor in found)
    frames = {
        sensor.name: candidates(
            sensor.lidar.maker,
            _places(table, sensor, metadata_topics),
            alone=makers[sensor.lidar.maker] == 1,
            sensor_from_lidar=sensor.lidar.sensor_from_lidar,
        )
        for sensor in found
    }
    named = dict(zip((sensor.name for sensor in found), rigged, strict=True))
    mounting = knowledge.mount(
        frames,
        {
            name: entry.extrinsics
            for name, entry in named.items()
            if entry is not None and entry.extrinsics is not None
        },
        {
            sensor.name: sensor.lidar.extrinsics
            for sensor in found
            if sensor.lidar.extrinsics is not None
        },
        None if rig is None else rig.body_frame,
        identity_extrinsics=identity_extrinsics,
    )
    mounts = mounting.mounts
    mounted = [
        Mounted(
            sensor,
            mounts[sensor.name].body_from_sensor,
            mounts[sensor.name].source,
            named[sensor.name],
            mounts[sensor.name].chain,
        )
        for sensor in found
    ]
    return mounted, mounting


def in_words(finding: Finding) -> str:
    """A finding as a line that names its sensor."""
    return f"sensor {finding.sensor}: {finding.message}" if finding.sensor else finding.message


def _places(table: StreamTable, sensor: Found, metadata_topics: Collection[str]) -> list[str]:
    """Words for where a sensor sits: topics of its packets, else of its metadata, else its name."""
    topics = sorted({table.streams[stream].topic for stream, _ in sensor.kinds} - {""})
    if not topics and sensor.lidar.calibration in metadata_topics:
        topics = [sensor.lidar.calibration]
    return topics or [sensor.name]
