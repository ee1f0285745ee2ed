"""The compiled library and its structs, declared as in `native.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar

import numpy.typing as npt

from mlbatch.native import library_path

_ABI = 16
_WORD = ctypes.c_int64
_ADDRESS = ctypes.c_void_p
_NUMBER = ctypes.c_double
# Takes every buffer; types of numpy name the protocol from Python 3.12 on.
_from_buffer: Callable[[Any], Any] = ctypes.c_char.from_buffer
# Arguments of the functions; they return a number, except some.
_FUNCTIONS: dict[str, tuple[type[Any], ...]] = {
    "mlbatch_abi": (),
    "mlbatch_decode": (_ADDRESS,),
    "mlbatch_pack": (_ADDRESS, _ADDRESS, _WORD, _ADDRESS),
    "mlbatch_angles": (_WORD, _ADDRESS, _ADDRESS, _ADDRESS),
    "mlbatch_merge": (_WORD, _ADDRESS, _WORD, *[_ADDRESS] * 5),
    "mlbatch_figures": (_WORD, *[_ADDRESS] * 4, _WORD, _ADDRESS, _WORD, _ADDRESS, _ADDRESS),
    "mlbatch_headers": (_ADDRESS, _ADDRESS, _WORD, *[_ADDRESS] * 9),
    "mlbatch_numbers": (_ADDRESS, _WORD, _ADDRESS),
    "mlbatch_take": (_ADDRESS, _ADDRESS, _ADDRESS),
    "mlbatch_walk": (_ADDRESS, *[_WORD] * 6, _ADDRESS, _ADDRESS),
    "mlbatch_dissect": (_ADDRESS, _ADDRESS, _WORD, _WORD, *[_ADDRESS] * 5),
    "mlbatch_keep": (_ADDRESS, _ADDRESS, _WORD, _ADDRESS, _WORD),
    "mlbatch_copy": (_WORD, *[_ADDRESS] * 5),
    "mlbatch_sums": (_WORD, _ADDRESS, _ADDRESS, _WORD, _ADDRESS),
    "mlbatch_cloud_points": (
        *(_WORD, _ADDRESS, _WORD, _ADDRESS, _ADDRESS, _WORD),
        *(_WORD, _ADDRESS, _ADDRESS, _WORD, *[_ADDRESS] * 3),
    ),
    "mlbatch_cloud_order": (_WORD, *[_ADDRESS] * 5),
    "mlbatch_cloud_columns": (_WORD, *[_ADDRESS] * 3, _WORD, _WORD, _ADDRESS, _ADDRESS),
    "mlbatch_cloud_times": (
        *(_WORD, _ADDRESS, _WORD, _ADDRESS, _WORD, _WORD, _WORD),
        *[_ADDRESS] * 7,
    ),
    "mlbatch_cloud_fill": (
        *(_ADDRESS, _WORD, _ADDRESS, _ADDRESS, _WORD, *[_ADDRESS] * 3),
        *(_WORD, _ADDRESS, _ADDRESS, _WORD, _WORD, *[_ADDRESS] * 3),
    ),
    "mlbatch_cloud_pack": (
        *(_WORD, *[_ADDRESS] * 4, _WORD, *[_ADDRESS] * 4),
        *(*[_WORD] * 3, _ADDRESS, _ADDRESS),
    ),
}
_WITHOUT_RESULT = (
    "mlbatch_pack",
    "mlbatch_copy",
    "mlbatch_headers",
    "mlbatch_numbers",
    "mlbatch_sums",
    "mlbatch_cloud_pack",
    "mlbatch_figures",
)


class Ring(ctypes.Structure):
    """Where the columns of a sensor are."""

    _fields_: ClassVar = [
        ("first", _ADDRESS),
        ("rows", _WORD),
        ("per_row", _WORD),
        ("row_bytes", _WORD),
        ("column_bytes", _WORD),
        ("base", _WORD),
    ]


class Field(ctypes.Structure):
    """An integer in a word of a pixel."""

    _fields_: ClassVar = [
        ("word", _WORD),
        ("shift", _WORD),
        ("mask", _WORD),
        ("is_big", _WORD),
    ]


class Group(ctypes.Structure):
    """Sensors that are decoded alike."""

    _fields_: ClassVar = [
        ("kind", _WORD),
        ("beams", _WORD),
        ("width", _WORD),
        ("returns", _WORD),
        ("step", _WORD),
        ("run_count", _WORD),
        ("runs", _ADDRESS),
        ("word_count", _WORD),
        ("word_bytes", _ADDRESS),
        ("fields", _ADDRESS),
        ("scale", _ADDRESS),
        ("silent", _WORD),
        ("dark_count", _WORD),
        ("dark", _ADDRESS),
        ("has_reflectivity", _WORD),
        ("rings", _ADDRESS),
        ("direction", _ADDRESS),
        ("origin", _ADDRESS),
        ("first_row", _ADDRESS),
        ("rows", _WORD),
        ("used", _ADDRESS),
        ("reach", _ADDRESS),
        ("firing_ns", _ADDRESS),
        ("tables", _WORD),
        ("cosine", _ADDRESS),
        ("sine", _ADDRESS),
        ("miss_m2", _ADDRESS),
        ("axis_m", _ADDRESS),
        ("planes", _ADDRESS),
        ("pose", _ADDRESS),
        ("azimuth_value", _ADDRESS),
        ("azimuth_slope", _ADDRESS),
        ("elevation_value", _ADDRESS),
        ("elevation_slope", _ADDRESS),
        ("steps", _WORD),
        ("coordinates", _WORD),
        ("pose_f8", _ADDRESS),
        ("sines", _ADDRESS),
        ("slots", _WORD),
        ("labels", _ADDRESS),
        ("order", _ADDRESS),
        ("order_step", _WORD),
        ("slot", _ADDRESS),
        ("typed", _WORD),
        ("sends_twice", _WORD),
        ("drops_repeated", _WORD),
        ("limits_m", _ADDRESS),
        ("counts", _ADDRESS),
    ]


class Piece(ctypes.Structure):
    """A piece of a packed record."""

    _fields_: ClassVar = [
        ("kind", _WORD),
        ("offset", _WORD),
        ("source", _WORD),
        ("bytes", _WORD),
    ]


class Scan(ctypes.Structure):
    """A scan under construction."""

    _fields_: ClassVar = [
        ("columns", _WORD),
        ("stamp_ns", _ADDRESS),
        ("sensor", _ADDRESS),
        ("ring_index", _ADDRESS),
        ("encoder", _ADDRESS),
        ("start_ns", _WORD),
        ("first_number", _WORD),
        ("first_row", _WORD),
        ("group_of", _ADDRESS),
        ("member_of", _ADDRESS),
        ("group_count", _WORD),
        ("groups", _ADDRESS),
        ("box_count", _WORD),
        ("boxes_m", _ADDRESS),
        ("row_slots", _WORD),
        ("moves", _ADDRESS),
        ("point", _ADDRESS),
        ("label", _ADDRESS),
        ("range_m", _ADDRESS),
        ("reflectivity", _ADDRESS),
        ("column", _ADDRESS),
        ("records", _ADDRESS),
        ("record_bytes", _WORD),
        ("piece_count", _WORD),
        ("pieces", _ADDRESS),
        ("near_columns", _WORD),
        ("stamp_start_ns", _WORD),
        ("totals", _ADDRESS),
    ]


class Totals(ctypes.Structure):
    """Totals of all points in a LAS header."""

    _fields_: ClassVar = [
        ("low", ctypes.c_float * 4),
        ("high", ctypes.c_float * 4),
        ("second", _WORD),
    ]


class Rows(ctypes.Structure):
    """Values of points to be packed."""

    _fields_: ClassVar = [
        ("point", _ADDRESS),
        ("label", _ADDRESS),
        ("range_m", _ADDRESS),
        ("reflectivity", _ADDRESS),
        ("step", _WORD),
    ]


class Part(ctypes.Structure):
    """Columns of a sensor that wait for their window."""

    _fields_: ClassVar = [
        ("sensor", _WORD),
        ("columns", _WORD),
        ("stamp_ns", _ADDRESS),
        ("ring_index", _ADDRESS),
        ("encoder", _ADDRESS),
    ]


class Reader(ctypes.Structure):
    """How the headers of a sensor's packets are read."""

    _fields_: ClassVar = [
        ("kind", _WORD),
        ("layout", _ADDRESS),
        ("packet_bytes", _WORD),
        ("columns", _WORD),
        ("has_number", _WORD),
        ("odd", _ADDRESS),
    ]


class Numbers(ctypes.Structure):
    """Sequence numbers of the packets of a sensor."""

    _fields_: ClassVar = [
        ("modulus", _WORD),
        ("newest", _WORD),
        ("doubtful", _WORD),
        ("is_sure", _WORD),
        ("lost", _WORD),
        ("reordered", _WORD),
    ]


class Intake(ctypes.Structure):
    """The intake of a sensor, from batch to batch."""

    _fields_: ClassVar = [
        ("reader", _ADDRESS),
        ("columns", _WORD),
        ("offsets", _ADDRESS),
        ("numbers", _ADDRESS),
        ("offset_ns", _WORD),
        ("by_host", _WORD),
        ("finds_jumps", _WORD),
        ("takes_all", _WORD),
        ("rejected", _ADDRESS),
        ("renumbered", _WORD),
        ("packets", _WORD),
        ("recent", _ADDRESS),
        ("heads", _ADDRESS),
        ("newest_ns", _WORD),
        ("newest_host_ns", _WORD),
        ("delivered_ns", _WORD),
        ("is_held", _WORD),
        ("held_host_ns", _WORD),
        ("held_key", _WORD),
        ("held_ring_index", _WORD),
        ("held_stamp_ns", _ADDRESS),
        ("held_encoder", _ADDRESS),
        ("held_valid", _ADDRESS),
    ]


class Arrival(ctypes.Structure):
    """Packets of a sensor in a batch."""

    _fields_: ClassVar = [
        ("packets", _WORD),
        ("data", _ADDRESS),
        ("start", _ADDRESS),
        ("position", _ADDRESS),
        ("host_ns", _ADDRESS),
        ("ring_index", _ADDRESS),
        ("keys", _ADDRESS),
        ("owned", _ADDRESS),
        ("is_read", _WORD),
        ("is_mine", _ADDRESS),
        ("faults", _ADDRESS),
        ("given_keys", _ADDRESS),
    ]


class Accepted(ctypes.Structure):
    """Accepted packets of a sensor in a batch."""

    _fields_: ClassVar = [
        ("position", _ADDRESS),
        ("host_ns", _ADDRESS),
        ("newest_ns", _ADDRESS),
        ("lowest_ns", _ADDRESS),
        ("sensor_ns", _ADDRESS),
        ("stamp_ns", _ADDRESS),
        ("encoder", _ADDRESS),
        ("ring_index", _ADDRESS),
        ("valid", _ADDRESS),
        ("read", _WORD),
        ("packets", _WORD),
        ("invalid", _WORD),
        ("oldest", _WORD),
        ("behind_ns", _WORD),
        ("ahead_ns", _WORD),
        ("before_ns", _WORD),
        ("after_ns", _WORD),
        ("before_host_ns", _WORD),
        ("after_host_ns", _WORD),
    ]


class Dissection(ctypes.Structure):
    """State of reading a capture, kept from frame to frame."""

    _fields_: ClassVar = [
        ("room", _WORD),
        ("datagram_count", _WORD),
        ("datagrams", _ADDRESS),
        ("front", _WORD),
        ("skipped", _ADDRESS),
        ("most_streams", _WORD),
        ("slot_count", _WORD),
        ("stream_count", _WORD),
        ("streams", _ADDRESS),
        ("stream_slots", _ADDRESS),
        ("most_age_ns", _WORD),
        ("most_sets", _WORD),
        ("set_count", _WORD),
        ("sets", _ADDRESS),
        ("part_count", _WORD),
        ("free_part", _WORD),
        ("parts", _ADDRESS),
        ("kept", _ADDRESS),
        ("held_bytes", _WORD),
        ("loose_bytes", _WORD),
        ("now_ns", _WORD),
        ("most_first", _WORD),
        ("first_count", _WORD),
        ("first_keys", _ADDRESS),
        ("odd_at", _WORD),
        ("odd_kind", _WORD),
        ("settled", _ADDRESS),
    ]


def address(array: npt.NDArray[Any]) -> int:
    """Return the address of a C-contiguous array; the caller keeps the array."""
    try:
        # A third of the time of the other way, and a window needs many addresses.
        return ctypes.addressof(_from_buffer(array))
    except (TypeError, ValueError) as err:
        # Arrays without elements, or that are read only, have no such buffer.
        if not array.flags.c_contiguous:
            raise ValueError("expected a C-contiguous array") from err
        return int(array.ctypes.data)


@lru_cache(maxsize=1)
def library() -> Any:
    """Return the loaded library; OSError if it is missing, or was built from other sources."""
    path = library_path()
    if path is None:
        raise OSError("none, since it was not compiled when mlbatch was installed")
    loaded = ctypes.CDLL(str(path))
    for name, arguments in _FUNCTIONS.items():
        function = getattr(loaded, name)
        function.argtypes = arguments
        function.restype = None if name in _WITHOUT_RESULT else _WORD
    if loaded.mlbatch_abi() != _ABI:
        raise OSError(f"{path.name} of another version")
    return loaded


@lru_cache(maxsize=1)
def trouble() -> str:
    """Return why the library cannot be used; "" if it can."""
    try:
        library()
    except (OSError, AttributeError) as err:
        return " ".join(str(err).split())
    return ""
