"""Conversion factors, and scan rates as exact rational numbers."""

from __future__ import annotations

import math
import re
from fractions import Fraction

from mlbatch.errors import UsageError

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
M_PER_MM = 1e-3
MM_PER_M = 1000
RAD_PER_DEG = math.pi / 180.0
# m/s2, CGPM 1901; the unit of Ouster's legacy IMU packets.
STANDARD_GRAVITY = 9.80665

MIN_RATE_HZ = Fraction(1, 4)
MAX_RATE_HZ = Fraction(1_000_000)
# `Fraction` alone accepts "1e999999999" and computes for hours.
_NUMBER = r"(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,2})?|\d+/\d+"
_MAX_CHARACTERS = 100
_MAX_DECIMALS = 9


def parse_rate(text: str, option: str = "rate") -> Fraction:
    """Return the exact rate in Hz of text as `10`, `29.97`, `10/3` or `1e1`; UsageError if none.

    option: its name in errors.
    """
    cleaned = text.strip()
    shown = cleaned if len(cleaned) <= 40 else cleaned[:40] + "..."
    if len(cleaned) > _MAX_CHARACTERS or re.fullmatch(_NUMBER, cleaned, re.ASCII) is None:
        raise UsageError(
            f"{option}: expected a positive number of Hz (10, 29.97 or 10/3), found {shown!r}; "
            "write a decimal number or a fraction"
        )
    try:
        rate = Fraction(cleaned)
    except ZeroDivisionError:
        raise UsageError(
            f"{option}: expected a fraction with a denominator above 0, found {shown!r}; "
            "write it as 10/3"
        ) from None
    if not MIN_RATE_HZ <= rate <= MAX_RATE_HZ:
        raise UsageError(
            f"{option}: expected {rate_text(MIN_RATE_HZ)} to {rate_text(MAX_RATE_HZ)} Hz, "
            f"found {shown!r}; lidars run at 5 to 20 Hz"
        )
    return rate


def rate_text(rate: Fraction) -> str:
    """Return exact text: `10`, `29.97`, or a fraction if up to 9 decimals are not exact."""
    for decimals in range(_MAX_DECIMALS + 1):
        scaled = rate * 10**decimals
        if scaled.denominator == 1:
            digits = str(scaled.numerator).rjust(decimals + 1, "0")
            return digits if decimals == 0 else f"{digits[:-decimals]}.{digits[-decimals:]}"
    return f"{rate.numerator}/{rate.denominator}"
