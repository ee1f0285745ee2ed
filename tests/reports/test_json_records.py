"""Records written as JSON and read back are the same, of the same types."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.reports.json_records import from_json, to_json


class Inner(NamedTuple):
    word: str
    pair: tuple[str, int]
    maybe: float | None = None


@dataclass(frozen=True, slots=True)
class Outer:
    number: int
    real: float
    is_so: bool
    counts: dict[str, int]
    inner: tuple[Inner, ...]
    pose: F64Array | None = field(default=None, compare=False)


VALUE = Outer(
    2**62 + 1,
    0.1,
    True,
    {"late": 3, "ä": 0},
    (Inner("x\udcff", ("a", -1)), Inner("", ("b", 2), 5e-324)),
    np.array([[0.1, -0.0], [1e300, 2.0**-1074]]),
)


def _again(value: Outer) -> Outer:
    found: Outer = from_json(Outer, json.loads(json.dumps(to_json(value))))
    return found


def test_a_record_read_back_is_the_same() -> None:
    found = _again(VALUE)
    assert found == VALUE
    assert type(found.inner[0]) is Inner
    assert found.pose is not None
    assert VALUE.pose is not None
    assert found.pose.dtype == np.float64
    assert found.pose.tobytes() == VALUE.pose.tobytes()


def test_nothing_stays_nothing() -> None:
    found = from_json(Outer, json.loads(json.dumps(to_json(Outer(0, 0.0, False, {}, ())))))
    assert found == Outer(0, 0.0, False, {}, ())
    assert found.pose is None


def test_not_a_number_stays_one() -> None:
    value = Outer(0, math.nan, False, {}, ())
    assert math.isnan(_again(value).real)


def test_a_whole_number_is_a_real() -> None:
    content = json.loads(json.dumps(to_json(VALUE))) | {"real": 3}
    found = from_json(Outer, content)
    assert (found.real, type(found.real)) == (3.0, float)


@pytest.mark.parametrize(
    "change",
    [
        {"number": True},
        {"number": "1"},
        {"number": None},
        {"number": 1.0},
        {"is_so": 1},
        {"real": "0.1"},
        {"counts": []},
        {"counts": {"late": "3"}},
        {"inner": {}},
        {"inner": [["x"]]},
        {"inner": [{"word": "x", "pair": ["a"], "maybe": None}]},
        {"inner": [{"word": "x", "pair": ["a", 1]}]},
        {"pose": [["a"]]},
        {"more": 1},
    ],
)
def test_other_values_are_refused(change: dict[str, Any]) -> None:
    content = json.loads(json.dumps(to_json(VALUE))) | change
    with pytest.raises(ValueError):
        from_json(Outer, content)
