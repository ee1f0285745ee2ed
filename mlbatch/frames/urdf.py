"""Joints of a robot description (URDF), the content of `robot_description`.

Source: docs/sources/messages.md section 6; ROS URDF/XML specification, elements `joint` and
`origin`: origin maps the frame of the child link into that of the parent, xyz in m, rpy in rad
about the fixed axes x, y, z, both 0 by default. Documents are untrusted: no document types (thus no
entities), at most 16 MB, and no tree of elements is built.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.units import RAD_PER_DEG

MAX_BYTES = 16 * 1024 * 1024
_REMEDY = "give the extrinsics in a rig file (--rig)"
_SHOWN_CHARS = 60
# Limit of lengths (m) and angles (rad).
_LARGEST = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """One joint; kind: fixed, revolute, ...; matrix: (4, 4) parent_from_child, m.

    The matrix of a moving joint is that of its zero position.
    """

    name: str
    kind: str
    parent: str
    child: str
    matrix: F64Array

    @property
    def is_fixed(self) -> bool:
        """True if the child never moves against its parent."""
        return self.kind == "fixed"


def joints(text: str) -> list[Joint]:
    """Return all joints of a URDF, in its order; RigError names what is unusable."""
    if len(text) > MAX_BYTES or len(text.encode("utf-8", "replace")) > MAX_BYTES:
        raise _error(f"at most {MAX_BYTES} bytes", "more")
    # Imported on demand: few recordings have a description.
    import xml.etree.ElementTree as ET

    collector = _Collector()
    parser = ET.XMLParser(target=collector)
    try:
        parser.feed(text)
        parser.close()
    except (ET.ParseError, UnicodeError) as err:
        raise _error("an XML document", str(err)) from err
    return [_joint(element) for element in collector.joints]


@dataclass(slots=True)
class _Element:
    """A `joint` element: its attributes, and the attributes of child elements by name."""

    attributes: Mapping[str, str]
    inner: dict[str, Mapping[str, str]] = field(default_factory=dict)


class _Collector:
    """Collects the joints directly under `robot`; other elements have children of that name too."""

    def __init__(self) -> None:
        self.joints: list[_Element] = []
        self._depth = 0
        self._is_in_joint = False

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse document types: their entities may grow without bounds or name files."""
        raise _error("a document without a document type", f"<!DOCTYPE {name}")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Collect the element if it is a joint or a child of one."""
        name = tag.rpartition("}")[2]
        if self._depth == 0 and name != "robot":
            raise _error("the element <robot> first", f"<{name}>")
        if self._depth == 1:
            self._is_in_joint = name == "joint"
            if self._is_in_joint:
                self.joints.append(_Element(attributes))
        elif self._depth == 2 and self._is_in_joint:
            self.joints[-1].inner[name] = attributes
        self._depth += 1

    def end(self, tag: str) -> None:
        """Leave a level."""
        self._depth -= 1

    def data(self, text: str) -> None:
        """Ignore text."""

    def close(self) -> None:
        """Do nothing; part of the parser's interface."""


def _joint(element: _Element) -> Joint:
    name = element.attributes.get("name", "")
    where = f"joint {name or '(no name)'}"
    links = [element.inner.get(key, {}).get("link", "").strip() for key in ("parent", "child")]
    if not all(links):
        raise _error("a parent link and a child link", "none", where)
    origin = element.inner.get("origin", {})
    xyz_m = _three(origin.get("xyz"), "xyz", where)
    rpy_rad = _three(origin.get("rpy"), "rpy", where)
    matrix = from_rpy_deg(xyz_m, [angle / RAD_PER_DEG for angle in rpy_rad])
    return Joint(name, element.attributes.get("type", ""), links[0], links[1], matrix)


def _three(text: str | None, key: str, where: str) -> list[float]:
    if text is None:
        return [0.0, 0.0, 0.0]
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(number) <= _LARGEST for number in numbers):
        raise _error(f"3 numbers of at most {_LARGEST:g}", text, f"{where}, origin {key}")
    return numbers


def _error(expected: str, found: str, where: str = "") -> RigError:
    shown = " ".join(found.split()) or "nothing"
    if len(shown) > _SHOWN_CHARS:
        shown = shown[: _SHOWN_CHARS - 3] + "..."
    place = f"robot_description (URDF){', ' if where else ''}{where}"
    return RigError(f"{place}: expected {expected}, found {shown}; {_REMEDY}")
