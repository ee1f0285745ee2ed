"""Clocks of sensors against the capture host's: which are off, by how much, and the remedies.

Sensors may agree with each other and not with the capture host: scans then are consistent, but at
wrong times for everything that was recorded with another clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mlbatch.clocks.timescale import (
    EPOCH_NS,
    GPS,
    TAI,
    TOP_OF_HOUR,
    UPTIME,
    WRONG_YEAR,
    domain_of,
    format_difference,
    gps_utc_s,
    known_difference,
    tai_utc_s,
)
from mlbatch.clocks.watch import ClockEstimate
from mlbatch.units import NS_PER_MS, NS_PER_S

# Largest difference that needs no warning.
LIMIT_NS = NS_PER_S
# Error of an offset where packets share the log time of a message, which may end a second later.
_UNTIMED_NS = NS_PER_S
_NAMED_WITHIN_NS = 50 * NS_PER_MS
# Time sources as sensors report them that are to give civil time (docs/sources/ouster.md, section
# 7; livox: others.md; robosense.md). A sensor counts from power-on until the source is locked.
_CIVIL_SOURCES = frozenset({"TIME_FROM_PTP_1588", "gPTP or PTP", "PTP", "GPS", "NTP"})
_CAUSES = {
    TOP_OF_HOUR: "a counter without GPS time, whose hour is taken from receive times",
    UPTIME: "it counts from power-on: the time source never locked",
    WRONG_YEAR: "a date that was never set",
}


class HostOffset(NamedTuple):
    """Clock of a sensor against the capture host's, in the middle of a recording."""

    sensor: str
    domain: str  # as in `ClockEstimate`
    offset_ns: int  # positive: ahead of the capture host's clock
    uncertainty_ns: int
    host_ns: int  # receive time at which it was measured
    source: str = ""  # time source that the sensor reports

    @classmethod
    def measured(cls, sensor: str, estimate: ClockEstimate) -> HostOffset:
        """Offset of a clock that was watched."""
        return cls(
            sensor,
            estimate.domain,
            estimate.offset_ns,
            estimate.uncertainty_ns,
            estimate.at_host_ns,
            estimate.mode,
        )

    @classmethod
    def of_message(
        cls, sensor: str, stamp_ns: int, host_ns: int, period_ns: int, source: str
    ) -> HostOffset:
        """Offset of a clock by the log time of one message; period_ns: as in `ClockWatch`."""
        offset_ns = stamp_ns - host_ns
        domain = domain_of(stamp_ns, offset_ns, period_ns)
        return cls(sensor, domain, offset_ns, _UNTIMED_NS, host_ns, source)

    @property
    def is_off(self) -> bool:
        """True for civil time more than LIMIT_NS off, or for a time source that never locked.

        A clock that is to count from power-on is not off, nor is one to which a capture host
        without a date is compared.
        """
        if self.host_ns < EPOCH_NS:
            return False
        if self.domain == UPTIME:
            return self.source in _CIVIL_SOURCES
        return abs(self.offset_ns) - self.uncertainty_ns > LIMIT_NS

    @property
    def cause(self) -> str:
        """Reason for the offset as far as it is known."""
        if self.domain in _CAUSES:
            source = f"; time source {self.source}" if self.source else ""
            return f"{_CAUSES[self.domain]}{source}"
        error_ns = self.uncertainty_ns + _NAMED_WITHIN_NS
        known = known_difference(self.offset_ns, self.host_ns, error_ns)
        if known is not None and "second" not in known[1]:
            return known[1]
        return "no known difference of timescales: the error of a time master or of the host"

    def rig_text(self, given_ns: int = 0) -> str:
        """The line of a rig that gives UTC; given_ns: correction that the rig already has."""
        ahead_s = {TAI: tai_utc_s(self.host_ns), GPS: gps_utc_s(self.host_ns)}.get(self.domain)
        if ahead_s is not None:
            error_ns = self.uncertainty_ns + _NAMED_WITHIN_NS
            if not given_ns and abs(self.offset_ns - ahead_s * NS_PER_S) <= error_ns:
                return f"clock: {{epoch: {self.domain}}}"
        return f"clock: {{offset_s: {(given_ns - self.offset_ns) / NS_PER_S:.3f}}}"


def remedies(rig_text: str, *, timed: bool, sensors: int = 1) -> str:
    """Remedies as text; timed: packets have receive times of their own."""
    options = "--clock host or --align-clocks, or " if timed else ""
    each = "" if sensors == 1 else "for every sensor "
    return f"use {options}{each}`{rig_text}` in the rig"


def describe_off(offsets: Sequence[HostOffset], given_ns: int = 0, *, timed: bool = True) -> str:
    """Warning about the clocks that are off; "" if none is.

    offsets: of sensors on comparable clocks; given_ns: correction that the rig already has.
    """
    off = [one for one in offsets if one.is_off]
    if not off:
        return ""
    # One correction for all, since they agree better with each other than with receive times.
    first = off[0]
    names = ", ".join(one.sensor for one in off)
    return (
        f"{names}: expected a clock within 1 s of the capture host's, found "
        f"{format_difference(first.offset_ns)} ({first.cause}); "
        f"{remedies(first.rig_text(given_ns), timed=timed, sensors=len(offsets))}"
    )
