"""Chains of transforms by hand, and their laws."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.frames.transforms import compose, from_rpy_deg
from mlbatch.frames.tree import Edge, FrameTree, difference, edge_of

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


def _tree(*edges: Edge) -> FrameTree:
    tree = FrameTree()
    for edge in edges:
        tree.add(edge)
    return tree


def _edge(
    parent: str,
    child: str,
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0),
    xyzw: Sequence[float] = NO_ROTATION,
    source: str = "tf_static",
) -> Edge:
    return edge_of(parent, child, xyz, xyzw, source)


def _moved(tree: FrameTree, a: str, b: str, point: tuple[float, float, float]) -> list[float]:
    """Coordinates in frame a of a point in frame b."""
    chain = tree.chain(a, b)
    assert chain is not None
    rows = chain.matrix.tolist()
    return [r[0] * point[0] + r[1] * point[1] + r[2] * point[2] + r[3] for r in rows[:3]]


def test_chain_over_a_common_ancestor() -> None:
    # With equal orientation, the right one is 2 m to the right (y = -2) of the left one.
    tree = _tree(
        _edge("base", "mast", (0.0, 0.0, 3.0)),
        _edge("mast", "left", (0.0, 1.0, 0.0)),
        _edge("mast", "right", (0.0, -1.0, 0.0)),
    )
    chain = tree.chain("left", "right")
    assert chain is not None
    assert chain.frames == ("left", "mast", "right")
    assert _moved(tree, "left", "right", (0, 0, 0)) == [0, -2, 0]
    assert tree.ancestor(["left", "right"]) == "mast"
    assert tree.ancestor(["left", "mast"]) == "mast"
    assert tree.ancestor(["left"]) == "left"
    assert tree.ancestor([]) is None


def test_two_parents_are_refused_where_they_matter() -> None:
    tree = _tree(_edge("base", "lidar"), _edge("os_sensor", "lidar"), _edge("lidar", "imu"))
    with pytest.raises(RigError) as caught:
        tree.chain("base", "imu")
    assert str(caught.value) == (
        "tf_static: frame lidar: expected one parent, found base and os_sensor; "
        "give the extrinsics in a rig file (--rig)"
    )
    # Frames below that one are unambiguous.
    assert _moved(tree, "lidar", "imu", (1, 2, 3)) == [1, 2, 3]
    assert tree.top("imu")[0] == "lidar"


@pytest.mark.parametrize("first", [0, 1, 2])
def test_circles_are_refused_in_any_order(first: int) -> None:
    circle = [_edge("a", "b"), _edge("b", "c"), _edge("c", "a")]
    tree = _tree(*circle[first:], *circle[:first], _edge("c", "lidar", (1.0, 0.0, 0.0)))
    with pytest.raises(RigError) as caught:
        tree.chain("a", "b")
    # From parent to child.
    assert str(caught.value) == (
        "tf_static: expected frames that form a tree, found the circle b -> c -> a -> b; "
        "give the extrinsics in a rig file (--rig)"
    )
    with pytest.raises(RigError, match="circle"):
        tree.chain("a", "lidar")
    # Frames below the circle keep their transforms up to it.
    assert _moved(tree, "c", "lidar", (0, 0, 0)) == [1, 0, 0]


@pytest.mark.parametrize(
    ("parent", "child", "xyz", "xyzw", "expected"),
    [
        ("a", "b", (0, math.nan, 0), NO_ROTATION, "expected 3 finite metres, found 0, nan, 0"),
        ("a", "b", (math.inf, 0, 0), NO_ROTATION, "expected 3 finite metres, found inf, 0, 0"),
        ("a", "b", (0, 0), NO_ROTATION, "expected 3 finite metres, found 0, 0"),
        ("a", "b", (0, 0, 0), (0, 0, 0, 0), "expected a quaternion of norm 1 within 0.001, found"),
        ("a", "/a", (0, 0, 0), NO_ROTATION, "expected two frames, found the same twice"),
        ("/", "b", (0, 0, 0), NO_ROTATION, "expected two frames, found an empty name"),
        ("a", " ", (0, 0, 0), NO_ROTATION, "expected two frames, found an empty name"),
    ],
)
def test_edges_that_are_none(
    parent: str, child: str, xyz: Sequence[float], xyzw: Sequence[float], expected: str
) -> None:
    with pytest.raises(RigError) as caught:
        FrameTree().add(edge_of(parent, child, xyz, xyzw, "tf_static"))
    text = str(caught.value)
    assert text.startswith("tf_static: transform ")
    assert expected in text
    assert "\n" not in text


def test_of_several_sources_the_first_wins_by_child() -> None:
    static = _tree(_edge("roof", "lidar", (0.0, 0.0, 1.0)))
    urdf = _tree(
        _edge("base", "roof", (5.0, 0.0, 0.0), source="urdf"),
        _edge("roof", "lidar", (0.0, 0.0, 9.0), source="urdf"),
    )
    whole = FrameTree.merged([static, urdf])
    assert _moved(whole, "base", "lidar", (0, 0, 0)) == [5, 0, 1]
    chain = whole.chain("base", "lidar")
    assert chain is not None
    assert [edge.source for edge in chain.edges] == ["urdf", "tf_static"]


def test_difference_by_hand() -> None:
    first = from_rpy_deg((1.0, 2.0, 3.0), (10.0, 20.0, 30.0))
    turned = compose(first, from_rpy_deg((0.0, 0.0, 0.0), (0.0, 0.5, 0.0)))
    assert difference(first, turned) == pytest.approx((0.0, math.radians(0.5)))
    moved = from_rpy_deg((1.003, 2.004, 3.0), (10.0, 20.0, 30.0))
    # 3 mm and 4 mm at a right angle are 5 mm.
    assert difference(first, moved) == pytest.approx((0.005, 0.0), abs=1e-9)
    # Half a revolution about any axis is the largest angle.
    half = from_rpy_deg((0.0, 0.0, 0.0), (180.0, 0.0, 0.0))
    assert difference(np.eye(4), half) == pytest.approx((0.0, math.pi))


LENGTHS = st.floats(min_value=-100.0, max_value=100.0)
ANGLES = st.floats(min_value=-180.0, max_value=180.0)
POSES = st.builds(from_rpy_deg, st.tuples(*[LENGTHS] * 3), st.tuples(*[ANGLES] * 3))


@st.composite
def _trees(draw: st.DrawFn) -> FrameTree:
    """A tree of up to 8 frames, 0 the root, in any order of edges."""
    count = draw(st.integers(min_value=3, max_value=8))
    edges = [
        Edge(str(draw(st.integers(0, child - 1))), str(child), draw(POSES), "tf_static")
        for child in range(1, count)
    ]
    return _tree(*draw(st.permutations(edges)))


def _matrix(tree: FrameTree, a: str, b: str) -> F64Array:
    chain = tree.chain(a, b)
    assert chain is not None
    assert (chain.frames[0], chain.frames[-1]) == (a, b)
    assert len(chain.edges) == len(chain.frames) - 1
    return chain.matrix


@given(_trees(), st.data())
def test_chains_compose_and_invert(tree: FrameTree, data: st.DataObject) -> None:
    a, b, c = (data.draw(st.sampled_from(tree.frames)) for _ in range(3))
    a_from_c = _matrix(tree, a, c)
    assert np.allclose(_matrix(tree, a, b) @ _matrix(tree, b, c), a_from_c, atol=1e-9)
    assert np.allclose(a_from_c @ _matrix(tree, c, a), np.eye(4), atol=1e-9)


@given(_trees(), st.data())
def test_all_frames_have_their_common_ancestor(tree: FrameTree, data: st.DataObject) -> None:
    frames = data.draw(st.lists(st.sampled_from(tree.frames), min_size=1, max_size=4))
    ancestor = tree.ancestor(frames)
    assert ancestor is not None
    for frame in frames:
        chain = tree.chain(ancestor, frame)
        assert chain is not None
        assert tuple(edge.parent for edge in chain.edges) == chain.frames[:-1]
