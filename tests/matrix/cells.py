"""Expected result of each fault: a table of declarations, by docs/faults.md.

A declaration names the fault as a user writes it ({v}: the victim), what it leaves of the packets
before the batching sees them, and which counts the report must contain. `touched` is the number of
packets that the report says the fault befell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tests.matrix.lidars import HOUR_NS, NS_PER_MS, NS_PER_S, VENDORS, Sent, Spell

Session = tuple[Sent, ...]
Change = Callable[[Session, int], Session]
# What a sensor's `packets` must say: from its packets sent, and those touched.
Counts = Mapping[str, Callable[[int, int], tuple[int, int]]]

# Length of the capture; events are at times well inside windows.
LENGTH_NS = 500 * NS_PER_MS
NOON_NS = 1_700_000_000 * NS_PER_S // HOUR_NS * HOUR_NS + 1000 * NS_PER_S
HALF_NS = 250 * NS_PER_MS
SHORT_WAIT = ("--max-wait", "0.1")


@dataclass(frozen=True, slots=True)
class Kind:
    """A row of the table; only one of `change`, `pieces`, `subset`, or none for identity.

    fault: "" none; send: the session of some vendors; change: what is left for the batching (the
    session, first receive time); subset: chance decides which packets are gone, any of them may be;
    pieces: outputs of `--on-jump split`, each a session; error: what the run says without it;
    counts: of the victim's packets, lowest and highest; wait_ns: of `words`.
    """

    fault: str = ""
    words: tuple[str, ...] = ()
    wait_ns: int = NS_PER_S
    change: Change | None = None
    subset: bool = False
    pieces: Callable[[Session, int], tuple[Session, ...]] | None = None
    error: tuple[str, ...] = ()
    refused_together: tuple[str, ...] = ()
    remedied: tuple[Callable[[str], Sent], str] | None = None
    counts: Counts | None = None
    session: Callable[[str], Sent] | None = None
    warnings: tuple[str, ...] = ()


def plain(vendor: str) -> Sent:
    """Half a second around noon."""
    row = VENDORS[vendor]
    return row.send(Spell(NOON_NS + row.begin_ns, LENGTH_NS))


def ahead(vendor: str) -> Sent:
    """The same half second by a clock that counts TAI."""
    row = VENDORS[vendor]
    ahead_ns = 37 * NS_PER_S
    return row.send(Spell(NOON_NS + row.begin_ns + ahead_ns, LENGTH_NS, ahead_ns=-ahead_ns))


def wrapping(vendor: str) -> Sent:
    """Half a second over the full hour, in which every count begins anew."""
    row = VENDORS[vendor]
    return row.send(
        Spell(NOON_NS // HOUR_NS * HOUR_NS - HALF_NS + row.begin_ns, LENGTH_NS, row.wrap)
    )


def restarting(vendor: str) -> Sent:
    """Up for 100 s at first; then all counts and clocks begin anew, but not the capture host's."""
    row = VENDORS[vendor]
    up_ns = 100 * NS_PER_S
    before = row.send(Spell(up_ns + row.begin_ns, HALF_NS - 20 * NS_PER_MS, 5000))
    again = Spell(row.begin_ns + 20 * NS_PER_MS, HALF_NS, 0, up_ns + HALF_NS)
    return before.then(row.send(again))


def _victim(session: Session, change: Callable[[Sent], Sent]) -> Session:
    return (*session[:-1], change(session[-1]))


def silent(from_ns: int, until_ns: int) -> Change:
    """The victim's packets of an interval after the first receive time are lost."""

    def change(session: Session, begin_ns: int) -> Session:
        def remaining(sent: Sent) -> Sent:
            since_ns = sent.host_ns - begin_ns
            return sent.where(np.flatnonzero((since_ns < from_ns) | (since_ns >= until_ns)))

        return _victim(session, remaining)

    return change


def shifted(by_ns: int) -> Change:
    """The victim's clock is off."""
    return lambda session, _: _victim(
        session, lambda sent: replace(sent, stamp_ns=sent.stamp_ns + by_ns)
    )


def drifting(ppm: int) -> Change:
    """The victim's clock gains from the first receive time on."""

    def change(session: Session, begin_ns: int) -> Session:
        def gaining(sent: Sent) -> Sent:
            gained_ns, rest = np.divmod((sent.host_ns - begin_ns) * ppm, 1_000_000)
            if rest.any():
                raise ValueError("expected gains of whole ns")
            return replace(sent, stamp_ns=sent.stamp_ns + gained_ns[:, None])

        return _victim(session, gaining)

    return change


def cut_at(at_ns: int, by_ns: int) -> Callable[[Session, int], tuple[Session, ...]]:
    """Two pieces, by receive time; in the second all clocks are off."""

    def pieces(session: Session, begin_ns: int) -> tuple[Session, ...]:
        first = []
        second = []
        for sent in session:
            late = sent.host_ns - begin_ns >= at_ns
            first.append(sent.where(np.flatnonzero(~late)))
            rest = sent.where(np.flatnonzero(late))
            second.append(replace(rest, stamp_ns=rest.stamp_ns + by_ns))
        return tuple(first), tuple(second)

    return pieces


def restarted(session: Session, begin_ns: int) -> tuple[Session, ...]:
    """Before and after the stamps step back."""
    first = []
    second = []
    for sent in session:
        again = int(np.argmax(np.diff(sent.stamp_ns[:, 0]) < 0)) + 1
        first.append(sent.where(np.arange(again)))
        second.append(sent.where(np.arange(again, len(sent.host_ns))))
    return tuple(first), tuple(second)


def _all(sent: int, touched: int) -> tuple[int, int]:
    return sent, sent


def _none(sent: int, touched: int) -> tuple[int, int]:
    return 0, 0


def _touched(sent: int, touched: int) -> tuple[int, int]:
    return touched, touched


def _without(sent: int, touched: int) -> tuple[int, int]:
    return sent - touched, sent - touched


def _with(sent: int, touched: int) -> tuple[int, int]:
    return sent + touched, sent + touched


def _between_others(sent: int, touched: int) -> tuple[int, int]:
    """Loss at the ends cannot be known."""
    return touched - 3, touched


def _nearly_all(sent: int, touched: int) -> tuple[int, int]:
    return sent - touched, sent


def _up_to(sent: int, touched: int) -> tuple[int, int]:
    return 0, touched


KINDS: Mapping[str, Kind] = {
    "drop": Kind(
        "drop:{v}:5%",
        subset=True,
        counts={
            "read": _without,
            "accepted": _without,
            "lost": _between_others,
            "reordered": _none,
        },
    ),
    "stall": Kind(
        "stall:{v}:0.15s-0.3s",
        SHORT_WAIT,
        100 * NS_PER_MS,
        silent(150 * NS_PER_MS, 300 * NS_PER_MS),
        counts={"read": _without, "accepted": _without, "lost": _touched, "reordered": _none},
    ),
    "late": Kind(
        "late:{v}:0.2s",
        SHORT_WAIT,
        100 * NS_PER_MS,
        silent(-1, 200 * NS_PER_MS),
        counts={"read": _without, "lost": _none, "reordered": _none},
    ),
    "early": Kind(
        "early:{v}:0.3s",
        SHORT_WAIT,
        100 * NS_PER_MS,
        silent(300 * NS_PER_MS, LENGTH_NS * 2),
        counts={"read": _without, "lost": _none, "reordered": _none},
    ),
    "duplicate": Kind(
        "dup:{v}:10%",
        counts={
            "read": _with,
            "accepted": _all,
            "duplicate": _touched,
            "lost": _none,
            "reordered": _none,
        },
    ),
    "reorder": Kind(
        "reorder:{v}:10%",
        counts={"read": _all, "accepted": _all, "lost": _none, "reordered": _touched},
    ),
    "delay": Kind(
        "delay:{v}:60ms",
        warnings=("clocks",),
        counts={"read": _all, "accepted": _all, "lost": _none, "reordered": _none},
    ),
    "offset": Kind(
        "jump:{v}:300ms@0s",
        change=shifted(300 * NS_PER_MS),
        warnings=("clocks",),
        counts={"read": _all, "accepted": _all, "lost": _none, "reordered": _none},
    ),
    "whole seconds": Kind(
        "jump:{v}:37s@0s",
        change=shifted(37 * NS_PER_S),
        refused_together=("37.", "--clock host", "clock.offset_s"),
        remedied=(ahead, "{offset_s: -37}"),
        # A vendor alone is converted; it is 37 s from the capture host.
        warnings=("clock_epoch",),
        counts={"read": _all, "accepted": _all, "lost": _none, "reordered": _none},
    ),
    "drift": Kind(
        "drift:{v}:500ppm",
        change=drifting(500),
        counts={"read": _all, "accepted": _all, "lost": _none, "reordered": _none},
    ),
    "jump forward": Kind(
        "jump:*:37s@0.25s",
        pieces=cut_at(HALF_NS, 37 * NS_PER_S),
        error=("clock jump within the recording", "a step forward", "--on-jump split"),
    ),
    "jump back": Kind(
        "jump:*:-20s@0.25s",
        pieces=cut_at(HALF_NS, -20 * NS_PER_S),
        error=("clock reset within the recording", "a step back", "--on-jump split"),
    ),
    "wrap": Kind(
        "reorder:{v}:10%",
        session=wrapping,
        counts={"read": _all, "accepted": _all, "lost": _none, "reordered": _touched},
    ),
    "restart": Kind(
        pieces=restarted,
        session=restarting,
        error=("clock reset within the recording", "a step back", "--on-jump split"),
    ),
    "bit flips": Kind(
        "bitflip:{v}:2%",
        subset=True,
        # Whether a bit is one that shows is chance.
        warnings=("rejected", "unassigned"),
        counts={"read": _nearly_all, "accepted": _nearly_all, "lost": _up_to, "reordered": _up_to},
    ),
    "truncation": Kind(
        "truncate:{v}:3%",
        subset=True,
        warnings=("rejected",),
        counts={
            "read": _all,
            "accepted": _without,
            "bad_size": _touched,
            "lost": _between_others,
            "reordered": _none,
        },
    ),
}
