"""Clocks that jump forward: a gap in the stamps that the recorder's clock did not see.

A sensor that was silent goes on where its clock is by then, and as much time has passed at the
recorder. Where stamps step by more than a second and arrivals do not, the clock was set: by PTP or
GPS that locked, or by a restart. Backward steps are told by `intake.py`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mlbatch.batching.intake import NEVER, STEP_NS, Delivery
from mlbatch.errors import ClockJump
from mlbatch.types import I64Array
from mlbatch.units import NS_PER_S


class Watch(Protocol):
    """What wants to know the stamps and arrivals of all accepted packets."""

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Take in packets (P,), in order of delivery."""
        ...


class JumpGuard:
    """Looks at the accepted packets of one sensor; `check` raises ClockJump.

    watch: told of all packets; None where arrivals are not known well enough. has_clock: False
    where stamps are arrivals, which tell nothing of a clock.
    """

    def __init__(self, name: str, watch: Watch | None = None, *, has_clock: bool = True) -> None:
        self.name = name
        self._watch = watch
        self._has_clock = has_clock
        self._newest_ns = NEVER
        self._host_ns = 0

    def check(self, delivery: Delivery) -> None:
        """Look at the next packets, in order of delivery."""
        if not self._has_clock:
            return
        stamp_ns, host_ns = delivery.newest_ns, delivery.packets.host_ns
        if len(stamp_ns) and int(stamp_ns.min()) <= NEVER:
            measured = stamp_ns > NEVER
            stamp_ns, host_ns = stamp_ns[measured], host_ns[measured]
        if not len(stamp_ns):
            return
        if self._newest_ns == NEVER:
            self._newest_ns, self._host_ns = int(stamp_ns[0]), int(host_ns[0])
        newest_ns = max(self._newest_ns, int(stamp_ns.max()))
        if newest_ns - self._newest_ns > STEP_NS:
            self._refuse_jump(stamp_ns, host_ns)
        self._newest_ns, self._host_ns = newest_ns, int(host_ns[-1])
        if self._watch is not None:
            self._watch.add(stamp_ns, host_ns)

    def _refuse_jump(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Look for a step of more than a second in the stamps that arrivals do not show."""
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], stamp_ns]))
        hosts = np.concatenate([[self._host_ns], host_ns])
        steps, passed = newest[1:] - newest[:-1], hosts[1:] - hosts[:-1]
        # Recorders without times of their own say nothing.
        jumps = (steps > STEP_NS) & (passed > 0) & (steps - passed > STEP_NS)
        if jumps.any():
            raise self._jump(newest, hosts, int(np.argmax(jumps)))

    def _jump(self, newest: I64Array, hosts: I64Array, at: int) -> ClockJump:
        before, after = int(newest[at]), int(newest[at + 1])
        passed = int(hosts[at + 1] - hosts[at])
        return ClockJump(
            f"sensor {self.name}: clock jump within the recording: stamps went forward from "
            f"{before / NS_PER_S:.6f} s to {after / NS_PER_S:.6f} s while only "
            f"{passed / NS_PER_S:.6f} s passed at the recorder; wanted one running clock; use "
            "--on-jump split, or --clock host",
            int(hosts[at + 1]),
        )
