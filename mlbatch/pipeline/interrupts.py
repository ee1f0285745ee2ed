"""Interrupts by signals, raised where they do no harm.

Python raises KeyboardInterrupt between any two instructions of the first thread. Within
`threading.Condition` that may leave its lock taken, so that threads wait for it for ever; within a
finalizer or the callback of a weak reference it is printed and ignored. `Uninterrupted` delays it,
`interruptible` repeats it.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# An interrupt that was ignored is raised again after this time.
_REPEAT_S = 0.01


class _Delayed:
    """State of the first thread. depth: of `Uninterrupted`; is_due: an interrupt waits."""

    depth = 0
    is_due = False


class Uninterrupted:
    """A block of the first thread in which an interrupt waits for its end, but not a second one."""

    def __enter__(self) -> None:
        _Delayed.depth += 1

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        _Delayed.depth -= 1
        if _Delayed.is_due and not _Delayed.depth:
            _Delayed.is_due = False
            raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt for SIGINT, SIGTERM and SIGHUP (the terminal was closed).

    Signals that are ignored remain so: nohup is to outlive its terminal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    caught = {number: one for number, one in before.items() if one is not signal.SIG_IGN}
    _Delayed.depth = 0
    _Delayed.is_due = False
    try:
        for number in caught:
            signal.signal(number, _interrupt)
        with _repeated(min(caught, default=signal.SIGINT)):
            yield
    finally:
        for number, one in caught.items():
            signal.signal(number, one)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _Delayed.depth and not _Delayed.is_due:
        _Delayed.is_due = True
        return
    raise KeyboardInterrupt


@contextlib.contextmanager
def _repeated(number: signal.Signals) -> Iterator[None]:
    """Repeat an interrupt that Python ignores, as this signal."""
    before = sys.unraisablehook
    timers: list[threading.Timer] = []

    def repeat(ignored: sys.UnraisableHookArgs) -> None:
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            # Later: here it would be ignored again.
            timers.append(threading.Timer(_REPEAT_S, _thread.interrupt_main, (number,)))
            timers[-1].start()
        else:
            before(ignored)

    sys.unraisablehook = repeat
    try:
        yield
    finally:
        sys.unraisablehook = before
        for timer in timers:
            timer.cancel()
