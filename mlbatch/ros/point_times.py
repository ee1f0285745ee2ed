"""Times of the points of decoded clouds: unit, zero, and whether both are plausible.

Drivers agree neither on the unit nor on the zero of the times of points, and state neither in the
message. The rig decides (`points:`), else type and values of the field by the conventions of the
drivers; a sweep takes about as long as the messages are apart, which confirms or refutes the unit.
Source: docs/sources/messages.md, section 8.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, median
from mlbatch.ros.point_packets import CloudError
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

# Numbers of the type of a cloud's time field.
Times: TypeAlias = npt.NDArray[Any]

TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "timestamps", "offset_time", "ts")
# Units by their names in a rig, largest first.
UNITS_NS: Mapping[str, int] = {"s": NS_PER_S, "ms": NS_PER_MS, "us": NS_PER_US, "ns": 1}
START = "start"
END = "end"
# Ages: each point was measured that long before the header's stamp.
BACK = "back"
ABSOLUTE = "absolute"
ORIGINS = (START, END, BACK, ABSOLUTE)

_LIMIT_NS = 2**31 * NS_PER_S
# Times of points after a header; times since 1970 are far above (1e8 s is 1973).
_MOST_AFTER_NS = 1000 * NS_PER_S
_LEAST_EPOCH_NS = 10**8 * NS_PER_S
# No revolution takes longer; times in another unit than the assumed one would.
_LONGEST_S = 10
_FLOAT64_BYTES = 8

# Span of the times of a cloud by the spacing of the messages: of a spinning lidar; below, points
# would share the time of the message; above, sweeps of several lidars overlap.
_SWEEP = (0.5, 1.2)
_LEAST_SPAN = 0.05
_MOST_SPAN = 1.5
# Below, points would share the time of the message if it is not a sector that the lidar sends.
_USUAL_SPAN = 0.5
# Points after the log time of their message that rounding, or a header with it, cannot explain.
_AHEAD_NS = 5 * NS_PER_MS
# Points on the other side of a stated zero: a driver stamps the first packet of a sweep or the
# last one, whose points are measured during the next milliseconds.
_PACKET_NS = 5 * NS_PER_MS
# From the last point to the log time of a message: a driver publishes a sweep when it is complete.
_USUAL_DELAY_NS = 20 * NS_PER_MS
# Headers that much before the log time are of a clock of another zero.
_MOST_DELAY_NS = NS_PER_S
# Log times that are copies of headers, rounded to microseconds.
_COPY_NS = NS_PER_US


@dataclass(frozen=True, slots=True)
class PointRule:
    """How the points of a topic are read; of the rig, or inferred.

    time, ring: names of fields, "": the first known one; unit_ns: ns of the unit of the times, 0:
    by convention; origin: one of ORIGINS, "": by convention; longest_ns: of a sweep; inferred: why
    the unit is not the conventional one; places: file, line and key of what the rig gives, by key.
    """

    time: str = ""
    unit_ns: int = 0
    origin: str = ""
    ring: str = ""
    longest_ns: int = field(default=_LONGEST_S * NS_PER_S, compare=False)
    inferred: str = field(default="", compare=False)
    places: Mapping[str, str] = field(default_factory=dict, compare=False)

    def keys(self) -> dict[str, str]:
        """The keys of a rig that it is made of, with empty values for those left out."""
        unit = _unit_name(self.unit_ns) if self.unit_ns else ""
        return {"time": self.time, "unit": unit, "from": self.origin, "ring": self.ring}

    def at(self, key: str) -> str:
        """The begin of an error about a key of the rig, or ""."""
        return f"{self.places[key]}: " if key in self.places else ""


CONVENTION = PointRule()


@dataclass(frozen=True, slots=True)
class Zero:
    """Candidate for the origin of times; field: name and type; base: description of base_ns."""

    field: str
    base_ns: int
    base: str


class Reading(NamedTuple):
    """Unit of times in ns, and whether they are since 1970."""

    unit_ns: int
    is_absolute: bool


# Meaning of floating-point times whose largest is above the first number and below the second.
_FLOAT_TIMES = (
    (-1e3, 1e3, Reading(NS_PER_S, is_absolute=False)),
    (1e8, 1e11, Reading(NS_PER_S, is_absolute=True)),
    (1e14, float(_LIMIT_NS), Reading(1, is_absolute=True)),
)


def stamps(time: Times, zero: Zero, rule: PointRule, all_times: Times) -> tuple[I64Array, str]:
    """Stamps (n,), ns, of points by their finite times (n > 0,); and the meaning of the times.

    all_times: those of the whole message, which may include points that are left out.
    """
    low = time.min()
    high = time.max()
    reading = _reading(time.dtype, float(high), rule)
    if reading is None:
        raise CloudError(
            f"field {zero.field}: expected s after {zero.base} (below 1000), or float64 s or ns "
            f"since 1970, found {high:g}; give its unit in the rig (points: {{unit: us}}), or "
            "record the raw packets"
        )
    unit_ns, is_absolute = reading
    _check_values(float(low), float(high), zero, reading)
    if time.dtype.kind == "f":
        ns = _float_ns(time.astype(np.float64), unit_ns)
    else:
        ns = time.astype(np.int64)
        ns *= unit_ns
    unit = _unit_name(unit_ns)
    why = f" ({rule.inferred})" if rule.inferred else ""
    if is_absolute:
        return ns, f"{zero.field}, {unit} since 1970{why}"
    if not 0 < zero.base_ns < _LIMIT_NS:
        raise CloudError(
            f"field {zero.field}: expected times after {zero.base}, found {zero.base_ns} ns there; "
            "set the clock of its driver and record again"
        )
    words = "up to" if high <= 0 > low else "after"
    _check_direction(float(low), float(high), unit_ns, zero, rule.origin)
    if rule.origin == END:
        words = "up to"
        if not _counts_back(low, high):
            ns -= _last_ns(all_times, high, unit_ns, rule.longest_ns)
    elif rule.origin == BACK:
        words = "before"
        np.negative(ns, out=ns)
    ns += zero.base_ns
    return ns, f"{zero.field}, {unit} {words} {zero.base}{why}"


def _counts_back(low: float, high: float) -> bool:
    """Whether times are those before their zero, as of a sweep whose end is stamped."""
    return low < 0 and -low > high


def _check_direction(low: float, high: float, unit_ns: int, zero: Zero, origin: str) -> None:
    """Refuse times on both sides of a zero that the rig says is the start or the end of a sweep."""
    low_ns = low * unit_ns
    high_ns = high * unit_ns
    is_back = _counts_back(low, high)
    if origin == START:
        expected = f"times of 0 and more after {zero.base}, that of the first point (from: start)"
        is_allowed = low_ns >= -_PACKET_NS
    elif origin == END:
        expected = (
            f"times up to 0, back from {zero.base}, or of 0 and more, in a sweep that ends there "
            "(from: end)"
        )
        is_allowed = high_ns <= _PACKET_NS if is_back else low_ns >= -_PACKET_NS
    elif origin == BACK:
        expected = f"times of 0 and more, each that long before {zero.base} (from: back)"
        is_allowed = low_ns >= -_PACKET_NS
    else:
        return
    if is_allowed:
        return
    readings = [f"remove from if they count from {zero.base} as they are"]
    if origin == START and high_ns <= _PACKET_NS:
        readings.insert(0, f"write from: end if {zero.base} is that of the last point")
    raise CloudError(
        f"field {zero.field}: expected {expected}, found {low_ns / NS_PER_MS:.3f} to "
        f"{high_ns / NS_PER_MS:.3f} ms; {', or '.join(readings)}"
    )


def _last_ns(all_times: Times, high: Any, unit_ns: int, longest_ns: int) -> int:
    """The last time of a sweep: also of shots without a return, unless it is impossible."""
    finite = all_times[np.isfinite(all_times)] if all_times.dtype.kind == "f" else all_times
    last = finite.max()
    # Points without a return may have any time.
    if float(last) * unit_ns > longest_ns:
        last = high
    if all_times.dtype.kind == "f":
        return int(_float_ns(np.array([last], np.float64), unit_ns)[0])
    return int(last) * unit_ns


def _float_ns(value: npt.NDArray[np.float64], unit_ns: int) -> I64Array:
    """Times in ns, rounded; in two parts, as a float64 of ns since 1970 has a step of 256."""
    whole = np.floor(value)
    ns = whole.astype(np.int64)
    ns *= unit_ns
    part = np.subtract(value, whole, out=whole)
    part *= unit_ns
    ns += np.rint(part, out=part).astype(np.int64)
    return ns


def _reading(kind: np.dtype[Any], high: float, rule: PointRule) -> Reading | None:
    """Unit and zero of times up to `high`: by the rule, else by convention; None if unknown."""
    reading = convention(kind, high)
    if rule.unit_ns:
        # Since 1970 if they are that large.
        reading = Reading(rule.unit_ns, high * rule.unit_ns >= _LEAST_EPOCH_NS)
    if reading is None or not rule.origin:
        return reading
    return Reading(reading.unit_ns, rule.origin == ABSOLUTE)


def convention(kind: np.dtype[Any], high: float) -> Reading | None:
    """Unit and origin that drivers use for times of a type up to `high`; None if unknown."""
    if kind.kind != "f":
        return Reading(1, is_absolute=False)
    readings = (reading for above, below, reading in _FLOAT_TIMES if above < high < below)
    reading = next(readings, None)
    if reading is not None and reading.is_absolute and kind.itemsize < _FLOAT64_BYTES:
        return None
    return reading


def _unit_name(unit_ns: int) -> str:
    return next(name for name, one_ns in UNITS_NS.items() if one_ns == unit_ns)


def _check_values(low: float, high: float, zero: Zero, reading: Reading) -> None:
    """Refuse times that cannot belong to one sweep."""
    unit_ns, is_absolute = reading
    remedy = "give its unit in the rig (points: {unit: us}), or record the raw packets"
    span_s = (high - low) * (unit_ns / NS_PER_S)
    if span_s > _LONGEST_S:
        raise CloudError(
            f"field {zero.field}: expected times of one cloud within {_LONGEST_S} s, found "
            f"{span_s:g} s; {remedy}"
        )
    low_ns = low * unit_ns
    high_ns = high * unit_ns
    if is_absolute and not (low_ns > 0 and high_ns < _LIMIT_NS):
        raise CloudError(
            f"field {zero.field}: expected times since 1970, found {high_ns / NS_PER_S:g} s; "
            "correct unit or from of `points` in the rig"
        )
    if not is_absolute and max(abs(low_ns), abs(high_ns)) > _MOST_AFTER_NS:
        raise CloudError(
            f"field {zero.field}: expected times within 1000 s of {zero.base}, found "
            f"{high_ns / NS_PER_S:g} s; correct unit or from of `points` in the rig"
        )


# -- plausibility, by the first messages of a topic -----------------------------------------------


@dataclass(frozen=True, slots=True)
class CloudSample:
    """Times of one message as they are stored.

    host_ns: log time; stamp_ns: of the header; kind: type of the field; low, high: of the points
    with a place; points: their number; zero: as in `stamps`.
    """

    host_ns: int
    stamp_ns: int
    kind: np.dtype[Any]
    low: float
    high: float
    points: int
    zero: Zero

    @property
    def span(self) -> float:
        """From the first to the last point, in the unit of the field."""
        return self.high - self.low


def checked_rule(
    samples: Sequence[CloudSample], rule: PointRule, topic: str, offset_ns: int | None = 0
) -> tuple[PointRule, list[str]]:
    """The rule by which a topic can be read, and warnings; CloudError if there is none.

    samples: of messages of one lidar, as far as their ids say; rule: of the rig, or CONVENTION;
    offset_ns: what the rig adds to the times of the lidar, None where it converts their epoch.
    """
    usable = [one for one in samples if one.points > 1]
    if not usable:
        return rule, []
    name = usable[-1].zero.field
    ways_out = (
        f"name the field of the times or its unit in the rig (points: {{time: FIELD, unit: ns}}), "
        f"or leave the topic out with --ignore {topic}"
    )
    span = median(np.array([one.span for one in usable]))
    spacing_ns = _spacing_ns(samples)
    apart = "" if spacing_ns is None else f" ({spacing_ns / NS_PER_MS:.3f} ms)"
    if span == 0:
        values = {value for one in usable for value in (one.low, one.high)}
        found = "0 for every point" if values == {0} else "one time for all points of a cloud"
        raise CloudError(
            f"field {name}: expected times of points that span about the spacing of the "
            f"messages{apart}, found {found}; {ways_out}"
        )
    if spacing_ns is None:
        return rule, []
    high = median(np.array([one.high for one in usable]))
    rule = replace(rule, longest_ns=round(_SWEEP[1] * spacing_ns))
    notes: list[str] = []
    if not rule.unit_ns:
        rule, notes = _inferred(usable[-1].kind, name, span, spacing_ns, high, rule, topic)
    reading = _reading(usable[-1].kind, high, rule)
    if reading is None:
        # Refused with its values when a cloud is read.
        return rule, notes
    unit_ns = reading.unit_ns
    share = span * unit_ns / spacing_ns
    if "unit" in rule.places:
        _refuse_unit(name, span, spacing_ns, unit_ns, rule)
    shown = f"{span * unit_ns / NS_PER_MS:.3f} ms in messages {apart.strip(' ()')} apart"
    if share < _LEAST_SPAN and "unit" not in rule.places:
        raise CloudError(
            f"field {name}: expected times of points that span at least 5 % of the spacing of the "
            f"messages, found {shown}; {ways_out}"
        )
    if _LEAST_SPAN <= share < _USUAL_SPAN and "unit" not in rule.places:
        notes.append(
            f"field {name}: points span {shown}, {100 * share:.0f} %, as those of a sector, of "
            f"another field or of another unit: write points: {{unit: {_unit_name(unit_ns)}}} in "
            "the rig if that is right"
        )
    if share > _MOST_SPAN and share * spacing_ns <= _LONGEST_S * NS_PER_S:
        text = (
            f"field {name}: expected sweeps of one lidar, found {shown}, which overlap: several "
            "lidars share the topic, or the driver accumulates sweeps"
        )
        if "unit" not in rule.places:
            raise CloudError(
                f"{text}; give each lidar a topic or a frame_id of its own, name the unit in the "
                f"rig (points: {{unit: ns}}), or leave the topic out with --ignore {topic}"
            )
        notes.append(text)
    notes += _against_log_times(usable, reading, name, offset_ns, is_stated=bool(rule.origin))
    return rule, notes


def origin_as_read(samples: Sequence[CloudSample], rule: PointRule) -> str:
    """The origin of ORIGINS by which a topic is read; "" where times count back from the header."""
    usable = [one for one in samples if one.points > 1]
    if not usable or rule.origin:
        return rule.origin
    sample = usable[-1]
    reading = _reading(sample.kind, sample.high, rule)
    if reading is not None and reading.is_absolute:
        return ABSOLUTE
    return "" if _counts_back(sample.low, sample.high) else START


def ahead_ns(samples: Sequence[CloudSample], rule: PointRule) -> int | None:
    """How far the last points of a topic are ahead of the log times of their messages, at most.

    None where that is unknown: log times that are copies of the header's, or unreadable times.
    """
    with_points = [one for one in samples if one.points]
    if not with_points or _are_copies(with_points):
        return None
    lasts = [(_last_stamp_ns(one, rule), one.host_ns) for one in with_points]
    return max((last - host_ns for last, host_ns in lasts if last is not None), default=None)


def _last_stamp_ns(sample: CloudSample, rule: PointRule) -> int | None:
    """The stamp of the last point of a message."""
    reading = _reading(sample.kind, sample.high, rule)
    if reading is None:
        return None
    if reading.is_absolute:
        return round(sample.high * reading.unit_ns)
    if rule.origin == END and not _counts_back(sample.low, sample.high):
        return sample.zero.base_ns
    if rule.origin == BACK:
        return sample.zero.base_ns - round(sample.low * reading.unit_ns)
    return sample.zero.base_ns + round(sample.high * reading.unit_ns)


def _inferred(
    kind: np.dtype[Any],
    name: str,
    span: float,
    spacing_ns: float,
    high: float,
    rule: PointRule,
    topic: str,
) -> tuple[PointRule, list[str]]:
    """The rule with the unit by which sweeps take as long as messages are apart, and a note."""
    usual = convention(kind, high)
    fits = [
        (unit, unit_ns)
        for unit, unit_ns in UNITS_NS.items()
        if _SWEEP[0] <= span * unit_ns / spacing_ns <= _SWEEP[1]
    ]
    unit, unit_ns = fits[0] if fits else ("", 0)
    is_usual = usual is not None and usual.unit_ns == unit_ns
    if not fits or is_usual or high * unit_ns >= _LIMIT_NS:
        return rule, []
    instead = "" if usual is None else f", not {_unit_name(usual.unit_ns)} as usual"
    span_text = f"{span * unit_ns / NS_PER_MS:.3f} ms in messages {spacing_ns / NS_PER_MS:.3f} ms"
    text = f"inferred by sweeps of {span_text} apart{instead}"
    note = (
        f"field {name}: its unit is {unit}, {text}; confirm it in the rig (points: "
        f"{{unit: {unit}}}), or leave the topic out with --ignore {topic}"
    )
    return replace(rule, unit_ns=unit_ns, inferred=text), [note]


def _refuse_unit(name: str, span: float, spacing_ns: float, unit_ns: int, rule: PointRule) -> None:
    """Refuse a unit of the rig by which no sweep is a revolution, where another one fits."""
    share = span * unit_ns / spacing_ns
    if _LEAST_SPAN <= share <= _MOST_SPAN:
        return
    # A sector may be short, but several sweeps in one message have times of any length.
    least = _LEAST_SPAN if share < _LEAST_SPAN else _SWEEP[0]
    for unit, other_ns in UNITS_NS.items():
        if least <= span * other_ns / spacing_ns <= _SWEEP[1]:
            raise CloudError(
                f"{rule.at('unit')}field {name}: expected times of points that span about the "
                f"spacing of the messages ({spacing_ns / NS_PER_MS:.3f} ms), found "
                f"{span * unit_ns / NS_PER_MS:.6g} ms by unit: {_unit_name(unit_ns)}; write unit: "
                f"{unit}, by which they span {span * other_ns / NS_PER_MS:.6g} ms"
            )


def _against_log_times(
    samples: Sequence[CloudSample],
    reading: Reading,
    name: str,
    offset_ns: int | None,
    *,
    is_stated: bool,
) -> list[str]:
    """A warning where points or headers do not fit the log times of their messages.

    A message is logged after its last point, and soon after it. is_stated: the rig says what its
    header is. Log times that are copies of the headers show nothing.
    """
    if offset_ns is None or _are_copies(samples):
        return []
    headers_ns = [one.stamp_ns + offset_ns - one.host_ns for one in samples]
    # Of all messages: a jump of the clock is reported as such.
    late_ns = min(headers_ns)
    what = "the header is"
    if reading.is_absolute:
        what = "the last points are"
        lasts_ns = (round(one.high * reading.unit_ns) - one.host_ns for one in samples)
        late_ns = min(lasts_ns) + offset_ns
    if late_ns > _USUAL_DELAY_NS:
        return [
            f"field {name}: {what} {late_ns / NS_PER_MS:.1f} ms later than the log time of every "
            "message, so the clock of the lidar is ahead of the log times: write "
            f"clock: {{offset_s: {(offset_ns - late_ns) / NS_PER_S:.3f}}} in the rig if the "
            "log times are right"
        ]
    if reading.is_absolute or is_stated:
        return []
    header_ns = round(median(np.array(headers_ns)))
    last_ns = round(median(np.array([one.high for one in samples])) * reading.unit_ns)
    ahead_ns = header_ns + last_ns
    states = (
        "then write points: {from: end} in the rig; if the header is that of the first point, "
        "write points: {from: start}"
    )
    if ahead_ns > _AHEAD_NS:
        return [
            f"field {name}: points are up to {ahead_ns / NS_PER_MS:.1f} ms later than the log time "
            "of their message, as where a driver stamps the header at the end of the sweep: "
            f"{states}"
        ]
    if last_ns > _USUAL_DELAY_NS < -ahead_ns and -header_ns <= _MOST_DELAY_NS:
        return [
            f"field {name}: messages are logged {-ahead_ns / NS_PER_MS:.1f} ms after their last "
            f"point if the header is that of the first point, {-header_ns / NS_PER_MS:.1f} ms "
            "after it if a driver stamps the header at the end of the sweep, and the log times do "
            f"not show which: {states}"
        ]
    return []


def _are_copies(samples: Sequence[CloudSample]) -> bool:
    """Whether log times are copies of the headers' stamps."""
    return all(abs(one.host_ns - one.stamp_ns) <= _COPY_NS for one in samples)


def _spacing_ns(samples: Sequence[CloudSample]) -> float | None:
    """Usual time between the messages of one lidar; None with a single one.

    Over two steps: of two lidars that are stamped together every other step is short. The lower
    quartile: gaps and jumps of the clock are long.
    """
    for times in ([one.stamp_ns for one in samples], [one.host_ns for one in samples]):
        known = np.unique(np.array(times, np.int64))
        if len(known) < 2:
            continue
        step = min(2, len(known) - 1)
        steps = np.sort(known[step:] - known[:-step])
        return float(steps[len(steps) // 4]) / step
    return None
