"""Rates are the number the user wrote, exactly."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import UsageError
from mlbatch.units import parse_rate, rate_text


@pytest.mark.parametrize(
    ("text", "numerator", "denominator"),
    [
        ("10", 10, 1),
        ("15", 15, 1),
        (" 20 ", 20, 1),
        ("10/3", 10, 3),
        ("29.97", 2997, 100),
        ("30000/1001", 30000, 1001),
        ("1e1", 10, 1),
        ("2.5E-1", 1, 4),
        ("0.25", 1, 4),
        (".5", 1, 2),
        ("10.", 10, 1),
        ("0.333333333333333333", 333333333333333333, 10**18),
        ("1000000", 1000000, 1),
    ],
)
def test_text_is_the_number(text: str, numerator: int, denominator: int) -> None:
    assert parse_rate(text) == Fraction(numerator, denominator)


FORM = "write a decimal number or a fraction"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", f"rate: expected a positive number of Hz (10, 29.97 or 10/3), found ''; {FORM}"),
        ("ten", f"rate: expected a positive number of Hz (10, 29.97 or 10/3), found 'ten'; {FORM}"),
        ("-10", f"rate: expected a positive number of Hz (10, 29.97 or 10/3), found '-10'; {FORM}"),
        ("nan", f"rate: expected a positive number of Hz (10, 29.97 or 10/3), found 'nan'; {FORM}"),
        ("inf", f"rate: expected a positive number of Hz (10, 29.97 or 10/3), found 'inf'; {FORM}"),
        (
            "10/0",
            "rate: expected a fraction with a denominator above 0, found '10/0'; write it as 10/3",
        ),
        (
            "0",
            "rate: expected 0.25 to 1000000 Hz, found '0'; lidars run at 5 to 20 Hz",
        ),
        (
            "0.2499999",
            "rate: expected 0.25 to 1000000 Hz, found '0.2499999'; lidars run at 5 to 20 Hz",
        ),
        (
            "1000001",
            "rate: expected 0.25 to 1000000 Hz, found '1000001'; lidars run at 5 to 20 Hz",
        ),
        (
            "1e99",
            "rate: expected 0.25 to 1000000 Hz, found '1e99'; lidars run at 5 to 20 Hz",
        ),
    ],
)
def test_other_text_is_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_rate(text)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "text", ["1e999999999", "9" * 5000, "1_0", "\u0661\u0660", "10 Hz", "1/2/3", "\n"]
)
def test_odd_text_is_refused_in_one_short_line(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_rate(text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("rate", "text"),
    [
        (Fraction(10), "10"),
        (Fraction(10, 3), "10/3"),
        (Fraction(2997, 100), "29.97"),
        (Fraction(1, 4), "0.25"),
        (Fraction(1, 2**40), "1/1099511627776"),
    ],
)
def test_rate_is_written_shortly_and_exactly(rate: Fraction, text: str) -> None:
    assert rate_text(rate) == text


@given(st.fractions(min_value=Fraction(1, 4), max_value=10**6, max_denominator=10**30))
def test_what_is_written_is_read_again(rate: Fraction) -> None:
    assert parse_rate(rate_text(rate)) == rate
