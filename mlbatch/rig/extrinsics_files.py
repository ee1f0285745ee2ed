"""Extrinsics of a rig in files of other programs, by a table of formats.

Formats of named frames state the direction: parent_from_child, as in ROS. Their files form one tree
of frames, and the pose is the chain from the body frame to the frame of the sensor. Matrices state
no direction, so the rig does. Rules: docs/rig.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.frames.transforms import compose, from_quaternion, from_rpy_deg, inverse, rigid
from mlbatch.frames.tree import Edge, FrameTree, clean, some
from mlbatch.lidar.limits import FAR_POSE_M
from mlbatch.rig.yaml_tree import Node, read_foreign, read_foreign_blocks
from mlbatch.units import RAD_PER_DEG

BODY_FROM_SENSOR = "body_from_sensor"
SENSOR_FROM_BODY = "sensor_from_body"
M = "m"
MM = "mm"
_MM_PER_M = 1000.0
# Lever arms of matrices in millimetres, at least: no origins of two devices are nearer. Parts of
# one device may be, where they are parallel.
_LEAST_M = 0.005
_LEAST_TURNED_M = 0.01
# Autoware: `velodyne_top_base_link` is the mounting face; points are in `velodyne_top`.
_HOUSING = "_base_link"
_POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_AXES = ("x", "y", "z")
_XYZW = ("x", "y", "z", "w")
# Poses of two files that differ more contradict each other.
_SAME = 1e-9


@dataclass(frozen=True, slots=True)
class ExtrinsicsFiles:
    """`extrinsics: {file: ...}` of a rig, before the body frame is known.

    files: in the order given; frame: of the sensor, "": the only one, or its serial number; parent:
    "": the body frame of the rig; keys: of matrices; direction: of their product; unit: of their
    translations, "": m if they are near; sensor_in_frame: (4, 4), m, None where the rig gives none.
    """

    node: Node
    files: tuple[Path, ...]
    frame: str = ""
    parent: str = ""
    keys: tuple[str, ...] = ()
    direction: str = ""
    unit: str = ""
    sensor_in_frame: F64Array | None = None

    def pose(self, body_frame: str, serial: str) -> F64Array:
        """Return (4, 4) body_from_sensor, m; RigError names file, key, expected and found."""
        roots = [_read(file, self.node, by_key=bool(self.keys)) for file in self.files]
        if self.keys:
            pose = _product(roots, self.keys, self.node, self.unit)
            pose = inverse(pose) if self.direction == SENSOR_FROM_BODY else pose
        else:
            pose = self._chain(roots, clean(self.parent or body_frame), serial)
        return pose if self.sensor_in_frame is None else compose(pose, self.sensor_in_frame)

    def _chain(self, roots: Sequence[Node], parent: str, serial: str) -> F64Array:
        """The pose of a frame of the files."""
        tree, formats = _tree(roots)
        key = "parent" if self.parent else "body_frame"
        self._refuse_unknown(tree, parent, key, "give `parent`, the frame that is the body frame")
        frame = clean(self.frame) or self._only_frame(tree, parent, serial)
        self._refuse_unknown(tree, frame, "frame", "correct it")
        try:
            chain = tree.chain(parent, frame)
        except RigError as err:
            raise self.node.error_here(str(err)) from err
        if chain is None:
            known = f"frames that connect {parent} with {frame}"
            remedy = "give `file` as a list of all files, or `parent`"
            raise self._error(known, "none", remedy)
        if (
            self.sensor_in_frame is None
            and formats.get(frame) == "Autoware"
            and frame.endswith(_HOUSING)
        ):
            raise self._error(
                f"sensor_in_frame, as {frame} is the mounting face of the housing and not the "
                "frame of the points",
                "none",
                "give the offset of the description, as {translation_m: [0, 0, 0.0377]} of a "
                "VLP-16, or zeros where the calibration is that of the points",
            )
        return chain.matrix

    def _refuse_unknown(self, tree: FrameTree, frame: str, key: str, remedy: str) -> None:
        if frame not in tree:
            known = some(tree.frames)
            raise self._error(f"a frame of the file as {key}, one of {known}", repr(frame), remedy)

    def _only_frame(self, tree: FrameTree, parent: str, serial: str) -> str:
        """The frame of a sensor without `frame`."""
        if serial in tree.frames:
            return serial
        others = [name for name in tree.frames if name != parent]
        if len(others) != 1:
            raise self._error(
                f"the key frame, since the file has {len(others)} of them",
                "none",
                f"give one of {some(others)}",
            )
        return others[0]

    def _error(self, expected: str, found: str, remedy: str) -> RigError:
        names = ", ".join(str(file) for file in self.files)
        return self.node.error(f"{expected} ({names})", found, remedy)


def _read(file: Path, node: Node, *, by_key: bool) -> Node:
    """The tree of a file; errors in it begin with the key of the rig.

    by_key: a mistake elsewhere in the file does not matter.
    """
    try:
        return read_foreign(file)
    except RigError as err:
        if by_key:
            blocks = read_foreign_blocks(file)
            if blocks.entries:
                return blocks
        raise node.error_here(str(err)) from err


# -- formats of named frames ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Format:
    """A format of named frames; matches: by the root of the file; edges: all of its transforms."""

    name: str
    matches: Callable[[Node], bool]
    edges: Callable[[Node], Iterator[Edge]]
    shape: str


def _tree(roots: Sequence[Node]) -> tuple[FrameTree, dict[str, str]]:
    """Transforms of all files as one tree; and the name of the format that has each child."""
    tree = FrameTree()
    formats: dict[str, str] = {}
    seen: dict[tuple[str, str], Edge] = {}
    for root in roots:
        form = next((one for one in _FORMATS if one.matches(root)), None)
        if form is None:
            known = ", ".join(f"{one.name} ({one.shape})" for one in _FORMATS)
            remedy = "give `key` and `direction` for a matrix, or another file"
            raise root.error(known, _keys(root), remedy)
        for edge in form.edges(root):
            other = seen.setdefault((edge.parent, edge.child), edge)
            if np.abs(other.matrix - edge.matrix).max() > _SAME:
                text = f"one transform {edge.parent} -> {edge.child}"
                raise root.error(text, "two that differ", "remove one of them")
            try:
                tree.add(edge)
            except RigError as err:
                raise root.error_here(str(err)) from err
            formats[edge.child] = form.name
    return tree, formats


def _keys(root: Node) -> str:
    """Description of a file's content, for errors."""
    if root.kind == "mapping":
        return f"keys {some(list(root.entries)) or 'none'}"
    return root.shown


def _transforms(root: Node) -> tuple[Node, ...]:
    """The messages of a file: one, a list, or those of a TFMessage."""
    if root.kind == "mapping" and "transforms" in root.entries:
        root = root.entries["transforms"]
    return root.items if root.kind == "list" else (root,)


def _transform_edges(root: Node) -> Iterator[Edge]:
    """geometry_msgs/TransformStamped: header.frame_id is the parent."""
    for message in _transforms(root):
        transform = message.entry("transform")
        origin = _numbers(transform.entry("translation"), _AXES)
        rotation = transform.entry("rotation")
        yield Edge(
            clean(_name(message.entry("header").entry("frame_id"))),
            clean(_name(message.entry("child_frame_id"))),
            _quaternion(rotation, origin, _numbers(rotation, _XYZW)),
            str(root.file),
        )


def _ouster_edges(root: Node) -> Iterator[Edge]:
    """`extrinsic_parameters.json`: p and q map points of source_frame into destination_frame."""
    for one in _transforms(root):
        origin = _numbers(one, [f"p_{axis}" for axis in _AXES])
        xyzw = _numbers(one, [f"q_{axis}" for axis in _XYZW])
        yield Edge(
            clean(_name(one.entry("destination_frame"))),
            clean(_name(one.entry("source_frame"))),
            _quaternion(one, origin, xyzw),
            str(root.file),
        )


def _is_autoware(root: Node) -> bool:
    children = [child for parent in root.entries.values() for child in parent.entries.values()]
    return any(set(_POSE_KEYS) & set(child.entries) for child in children)


def _autoware_edges(root: Node) -> Iterator[Edge]:
    """Autoware: parent, child, metres and radians; R = Rz Ry Rx, as in the URDF they are for."""
    for parent, children in root.entries.items():
        for child, pose in children.entries.items():
            x, y, z, *angles = _numbers(pose, _POSE_KEYS)
            degrees = [angle / RAD_PER_DEG for angle in angles]
            _refuse_degrees(pose, angles)
            matrix = from_rpy_deg([x, y, z], degrees)
            yield Edge(clean(parent), clean(child), matrix, str(root.file))


def _refuse_degrees(pose: Node, angles_rad: Sequence[float]) -> None:
    """Refuse angles that are radians of more than a revolution."""
    for key, angle in zip(_POSE_KEYS[3:], angles_rad, strict=True):
        if abs(angle) > 2 * math.pi:
            node = pose.entries[key]
            raise node.error("radians, within 2 pi", node.shown, "convert degrees to radians")


_FORMATS = (
    _Format(
        "TransformStamped",
        lambda root: any("child_frame_id" in one.entries for one in _transforms(root)),
        _transform_edges,
        "header.frame_id, child_frame_id, transform",
    ),
    _Format(
        "Ouster",
        lambda root: any("p_x" in one.entries for one in _transforms(root)),
        _ouster_edges,
        "transforms with source_frame, destination_frame, p_x",
    ),
    _Format(
        "Autoware", _is_autoware, _autoware_edges, "parent: {child: {x, y, z, roll, pitch, yaw}}"
    ),
)


def _name(node: Node) -> str:
    """The name of a frame; a serial number is text, too."""
    if node.kind != "scalar" or node.is_null() or not node.text.strip("/ "):
        raise node.error("the name of a frame", node.shown, "correct it")
    return node.text


def _numbers(node: Node, keys: Sequence[str]) -> list[float]:
    return [node.entry(key).number() for key in keys]


def _quaternion(node: Node, origin: Sequence[float], xyzw: Sequence[float]) -> F64Array:
    try:
        return from_quaternion(origin, xyzw)
    except RigError as err:
        raise node.error_here(str(err)) from err


# -- matrices -------------------------------------------------------------------------------------

_SHAPES = {(4, 4): "4 x 4", (3, 4): "3 x 4", (3, 3): "3 x 3", (3, 1): "3 x 1"}


def _product(roots: Sequence[Node], keys: Sequence[str], rig: Node, unit: str) -> F64Array:
    """The product of matrices in the order of the keys, m."""
    product = np.eye(4)
    before = ""
    for key in keys:
        node = _at(roots, key, rig)
        values = _matrix(node)
        if before == "3 x 3" and values.shape == (3, 1):
            raise node.error(
                "a translation (3 x 1) before its rotation (3 x 3) in `key`",
                "it after",
                "write key: [TRANSLATION, ROTATION], as p = R q + t",
            )
        before = _SHAPES[values.shape[0], values.shape[1]]
        matrix = np.eye(4)
        if values.shape == (3, 1):
            matrix[:3, 3] = values[:, 0]
        else:
            matrix[: values.shape[0], : values.shape[1]] = values
        away = float(np.linalg.norm(matrix[:3, 3]))
        if not unit and not away <= FAR_POSE_M:
            raise node.error(
                f"a translation in metres, at most {FAR_POSE_M:g} m on a vehicle",
                f"one of {away:g}",
                f"write `matrix_unit: mm` next to `key` ({rig.place}) if the file has millimetres, "
                "or `matrix_unit: m`",
            )
        if unit == MM:
            matrix[:3, 3] /= _MM_PER_M
        try:
            product = compose(product, rigid(matrix))
        except RigError as err:
            raise node.error_here(str(err)) from err
    arm_m = float(np.linalg.norm(product[:3, 3]))
    least_m = _LEAST_M if np.allclose(product[:3, :3], np.eye(3)) else _LEAST_TURNED_M
    if unit == MM and 0 < arm_m < least_m:
        raise node.error(
            f"translations in millimetres, of {least_m * _MM_PER_M:g} mm or more between body and "
            "sensor",
            f"{arm_m * _MM_PER_M:.4g} mm, {arm_m * _MM_PER_M:.4g} m if the file has metres",
            f"write `matrix_unit: m` next to `key` ({rig.place}), or give such a pose as "
            "translation_m with a rotation",
        )
    return product


def _at(roots: Sequence[Node], key: str, rig: Node) -> Node:
    """The value of a key, whose parts are separated by dots, in the one file that has it."""
    found = [node for root in roots if (node := _below(root, key)) is not None]
    if len(found) != 1:
        names = ", ".join(str(root.file) for root in roots)
        known = some([name for root in roots for name in root.entries]) or "none"
        raise rig.error(
            f"the key {key} in one file ({names})",
            f"it in {len(found)}; keys: {known}",
            "correct `key` or `file`",
        )
    return found[0]


def _below(node: Node, key: str) -> Node | None:
    """The value of a key, or of a path of keys; keys may contain dots themselves."""
    if key in node.entries:
        return node.entries[key]
    for name, child in node.entries.items():
        if key.startswith(f"{name}."):
            value = _below(child, key[len(name) + 1 :])
            if value is not None:
                return value
    return None


def _matrix(node: Node) -> F64Array:
    """A matrix of OpenCV (rows, cols, data), or a list of rows or of 16, 12, 9 or 3 numbers."""
    if node.kind == "mapping" and {"rows", "cols", "data"} <= set(node.entries):
        rows = node.entry("rows").whole(1, 4)
        columns = node.entry("cols").whole(1, 4)
        values = node.entry("data").numbers(rows * columns)
        shape = rows, columns
    elif node.kind == "list" and node.items and node.items[0].kind == "list":
        width = len(node.items[0].items)
        values = [value for row in node.items for value in row.numbers(width)]
        shape = len(node.items), width
    elif node.kind == "list" and len(node.items) in _LISTS:
        shape = _LISTS[len(node.items)]
        values = node.numbers(len(node.items))
    else:
        shape = 0, 0
        values = []
    shape = (3, 1) if shape == (1, 3) else shape
    if shape not in _SHAPES:
        found = node.shown if shape == (0, 0) else f"{shape[0]} x {shape[1]}"
        expected = f"a matrix of {', '.join(_SHAPES.values())}"
        raise node.error(expected, found, "name the key of a matrix, or of a list of its rows")
    return np.array(values, np.float64).reshape(shape)


_LISTS: Mapping[int, tuple[int, int]] = {16: (4, 4), 12: (3, 4), 9: (3, 3), 3: (3, 1)}
