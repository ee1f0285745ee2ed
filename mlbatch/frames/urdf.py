"""Joints of a robot description (URDF), as `robot_description` holds it.

Source: facts/messages.md section 6; ROS URDF/XML specification, elements `joint` and `origin`:
origin maps the child link's frame into the parent's, xyz in metres, rpy in radians about the fixed
axes x, y, z, both 0 where absent. Documents come with a recording, so they are not trusted: no
document types (and thus no entities), no more than 16 MB, and no tree of elements is built.
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
# No robot is larger (m), no angle needs more turns (rad); NaN is not less.
_MOST = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """One joint; kind: fixed, revolute, ...; matrix: (4, 4) parent_from_child, metres.

    Of a joint that moves, the matrix is where it stands at its zero position.
    """

    name: str
    kind: str
    parent: str
    child: str
    matrix: F64Array

    @property
    def is_fixed(self) -> bool:
        """Whether the child never moves against its parent."""
        return self.kind == "fixed"


def joints(text: str) -> list[Joint]:
    """All joints of a URDF, in its order; RigError names what cannot be used."""
    if len(text) > MAX_BYTES or len(text.encode("utf-8", "replace")) > MAX_BYTES:
        raise _error(f"at most {MAX_BYTES} bytes", "more")
    # Hardly any recording holds a description.
    import xml.etree.ElementTree as ET

    collector = _Collector()
    parser = ET.XMLParser(target=collector)
    try:
        parser.feed(text)
        parser.close()
    except (ET.ParseError, UnicodeError) as err:
        raise _error("an XML document", str(err)) from err
    return [_joint(element) for element in collector.joints]


def fixed_joints(text: str) -> list[tuple[str, str, F64Array]]:
    """Parent link, child link and parent_from_child (4, 4), metres, of all fixed joints."""
    return [(one.parent, one.child, one.matrix) for one in joints(text) if one.is_fixed]


@dataclass(slots=True)
class _Element:
    """A `joint` element: its attributes, and those of the elements in it."""

    attributes: Mapping[str, str]
    inner: dict[str, Mapping[str, str]] = field(default_factory=dict)


class _Collector:
    """Keeps the joints right under `robot`: transmissions have elements of the same name."""

    def __init__(self) -> None:
        self.joints: list[_Element] = []
        self._depth = 0
        self._is_in_joint = False

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse: entities of a document type may grow without bounds or name files."""
        raise _error("a document without a document type", f"<!DOCTYPE {name}")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Keep the element if it is a joint or a part of one."""
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
        """Count the levels."""
        self._depth -= 1

    def data(self, text: str) -> None:
        """URDF says nothing in text."""

    def close(self) -> None:
        """Nothing is left to do."""


def _joint(element: _Element) -> Joint:
    name = element.attributes.get("name", "")
    where = f"joint {name or '(no name)'}"
    links = [element.inner.get(key, {}).get("link", "").strip() for key in ("parent", "child")]
    if not all(links):
        raise _error("a parent link and a child link", "none", where)
    origin = element.inner.get("origin", {})
    xyz_m, rpy_rad = (_three(origin.get(key), key, where) for key in ("xyz", "rpy"))
    matrix = from_rpy_deg(xyz_m, [angle / RAD_PER_DEG for angle in rpy_rad])
    return Joint(name, element.attributes.get("type", ""), links[0], links[1], matrix)


def _three(text: str | None, key: str, where: str) -> list[float]:
    if text is None:
        return [0.0, 0.0, 0.0]
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(number) <= _MOST for number in numbers):
        raise _error(f"3 numbers of at most {_MOST:g}", text, f"{where}, origin {key}")
    return numbers


def _error(expected: str, found: str, where: str = "") -> RigError:
    shown = " ".join(found.split()) or "nothing"
    if len(shown) > _SHOWN_CHARS:
        shown = shown[: _SHOWN_CHARS - 3] + "..."
    place = f"robot_description (URDF){', ' if where else ''}{where}"
    return RigError(f"{place}: expected {expected}, found {shown}; {_REMEDY}")
