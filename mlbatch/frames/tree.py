"""Trees of the coordinate frames of a recording, and the transforms between frames.

An edge maps coordinates of its child into its parent. A contradiction is an error only for chains
that contain it: recordings have many frames that no lidar needs. Source: docs/sources/messages.md
section 6 (tf2_msgs/TFMessage).
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.frames.transforms import compose, from_quaternion, inverse, quaternion

# Vehicles have less than 200.
MOST_FRAMES = 1000
_REMEDY = "give the extrinsics in a rig file (--rig)"


class Edge(NamedTuple):
    """A transform of a source; matrix: (4, 4) float64 parent_from_child, m."""

    parent: str
    child: str
    matrix: F64Array
    source: str

    def __str__(self) -> str:
        return f"{self.parent} -> {self.child}"


class Chain(NamedTuple):
    """The transforms from frame a to frame b; matrix: (4, 4) float64 a_from_b, m.

    frames: all from a to b; edges: between them.
    """

    matrix: F64Array
    frames: tuple[str, ...]
    edges: tuple[Edge, ...]

    def __str__(self) -> str:
        return " -> ".join(self.frames)


class _Climb(NamedTuple):
    """The path from a frame to its root; problem: why it ends before, "" at a root."""

    frames: list[str]
    edges: list[Edge]
    problem: str


def clean(frame: str) -> str:
    """Return a frame name without the leading slash that ROS 1 allowed."""
    return frame.strip().lstrip("/")


def edge_of(
    parent: str,
    child: str,
    translation_m: Sequence[float],
    xyzw: Sequence[float],
    source: str,
) -> Edge:
    """Return the edge of a geometry_msgs/TransformStamped; RigError if it is no rigid transform."""
    where = f"{source}: transform {clean(parent)} -> {clean(child)}"
    if len(translation_m) != 3 or not all(map(math.isfinite, translation_m)):
        shown = ", ".join(f"{value:g}" for value in translation_m)
        raise RigError(f"{where}: expected 3 finite metres, found {shown}; {_REMEDY}")
    try:
        matrix = from_quaternion(translation_m, xyzw)
    except RigError as err:
        raise RigError(f"{where}: {err}") from err
    return Edge(clean(parent), clean(child), matrix, source)


class FrameTree:
    """Edges by child; an edge replaces an earlier one of the same child and parent."""

    __slots__ = ("_above", "_frames")

    def __init__(self) -> None:
        self._above: dict[str, dict[str, Edge]] = {}
        self._frames: dict[str, None] = {}

    @classmethod
    def merged(cls, trees: Iterable[FrameTree]) -> FrameTree:
        """Merge trees, each of one source; the edges of a child come from the first that has some.

        Edges that close a circle with edges of earlier trees are skipped: one source may have the
        sensor as root, another the vehicle.
        """
        merged = cls()
        for tree in trees:
            for child, parents in tree._above.items():
                if child not in merged._above:
                    for edge in parents.values():
                        if not merged._closes_circle(edge):
                            merged.add(edge)
        return merged

    def add(self, edge: Edge) -> None:
        """Add an edge; RigError unless it connects two named frames."""
        if not edge.parent or not edge.child or edge.parent == edge.child:
            found = "an empty name" if edge.parent != edge.child else "the same twice"
            raise RigError(
                f"{edge.source}: transform {edge.parent!r} -> {edge.child!r}: expected two frames, "
                f"found {found}; {_REMEDY}"
            )
        self._above.setdefault(edge.child, {})[edge.parent] = edge
        self._frames.update(dict.fromkeys((edge.parent, edge.child)))

    def __contains__(self, frame: str) -> bool:
        return frame in self._frames

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames, sorted."""
        return tuple(sorted(self._frames))

    def chain(self, a: str, b: str) -> Chain | None:
        """Return the chain a_from_b; None if not connected, RigError if ambiguous."""
        up_a = self._climb(a)
        up_b = self._climb(b)
        above_b = set(up_b.frames)
        meeting = next((frame for frame in up_a.frames if frame in above_b), None)
        if meeting is None:
            if up_a.problem or up_b.problem:
                raise RigError(up_b.problem or up_a.problem)
            return None
        edges_a = up_a.edges[: up_a.frames.index(meeting)]
        edges_b = up_b.edges[: up_b.frames.index(meeting)]
        matrix = _product(edges_b)
        if edges_a:
            matrix = compose(inverse(_product(edges_a)), matrix)
        down = [edge.child for edge in reversed(edges_b)]
        frames = (*(edge.child for edge in edges_a), meeting, *down)
        return Chain(matrix, frames, (*edges_a, *reversed(edges_b)))

    def poses(self, body: str, most: int = MOST_FRAMES) -> dict[str, F64Array]:
        """Return (4, 4) body_from_frame, m, of the first `most` frames connected with `body`."""
        found: dict[str, F64Array] = {}
        if body not in self:
            return found
        for frame in self.frames:
            try:
                chain = self.chain(body, frame)
            except RigError:
                continue
            if chain is not None and frame != body and len(found) < most:
                found[frame] = chain.matrix
        return found

    def ancestor(self, frames: Sequence[str]) -> str | None:
        """Return the nearest common ancestor of `frames`, which may be one of them."""
        if not frames:
            return None
        paths = [self._climb(frame).frames for frame in frames]
        shared = set(paths[0]).intersection(*paths[1:])
        return next((frame for frame in paths[0] if frame in shared), None)

    def top(self, frame: str) -> tuple[str, str]:
        """Return the highest certain ancestor of `frame`, and why it is the last ("": a root)."""
        up = self._climb(frame)
        return up.frames[-1], up.problem

    def unknown(self, frame: str) -> str:
        """Return the error text for a frame that is not in the tree."""
        near = difflib.get_close_matches(frame, self._frames, 1)
        hint = f"did you mean {near[0]}?" if near else f"it has {some(self.frames) or 'none'}"
        return f"expected a frame of the recording's transforms, found {frame!r}; {hint}"

    def _climb(self, frame: str) -> _Climb:
        if frame not in self._frames:
            raise RigError(self.unknown(frame))
        # Number of edges from the first frame to each.
        place = {frame: 0}
        edges: list[Edge] = []
        while len(parents := self._above.get(frame, {})) == 1:
            (edge,) = parents.values()
            first = place.get(edge.parent)
            if first is not None:
                down = [one.child for one in reversed([*edges[first:], edge])]
                text = (
                    f"{edge.source}: expected frames that form a tree, found the circle "
                    f"{' -> '.join([edge.parent, *down])}; {_REMEDY}"
                )
                # Frames below the circle keep their transforms up to it.
                return _Climb(list(place)[: first + 1], edges[:first], text)
            edges.append(edge)
            frame = edge.parent
            place[frame] = len(edges)
        return _Climb(list(place), edges, _two_parents(frame, parents))

    def _closes_circle(self, edge: Edge) -> bool:
        """Return whether an edge closes a circle with edges of other sources."""
        frame = edge.parent
        seen = {edge.child}
        has_others = False
        while frame not in seen and len(parents := self._above.get(frame, {})) == 1:
            seen.add(frame)
            (above,) = parents.values()
            has_others |= above.source != edge.source
            frame = above.parent
        return frame == edge.child and has_others


def difference(first: F64Array, second: F64Array) -> tuple[float, float]:
    """Return the distance of two poses of one frame in m, and the angle between them in rad."""
    x, y, z, w = quaternion(compose(inverse(first), second))
    return math.dist(first[:3, 3], second[:3, 3]), 2 * math.atan2(math.hypot(x, y, z), w)


def _product(edges: Sequence[Edge]) -> F64Array:
    """Return the transform from the child of the first edge into the parent of the last."""
    matrix = np.eye(4)
    for edge in reversed(edges):
        matrix = compose(matrix, edge.matrix)
    return matrix


def _two_parents(frame: str, parents: Mapping[str, Edge]) -> str:
    if len(parents) < 2:
        return ""
    sources = " and ".join(dict.fromkeys(edge.source for edge in parents.values()))
    return (
        f"{sources}: frame {frame}: expected one parent, found {' and '.join(sorted(parents))}; "
        f"{_REMEDY}"
    )


def some(words: Sequence[str], most: int = 8) -> str:
    """Return the first `most` words of a list as text."""
    text = ", ".join(words[:most])
    return text if len(words) <= most else f"{text} and {len(words) - most} more"
