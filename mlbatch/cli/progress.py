"""Progress on stderr: a bar on a terminal; with -v one line per minute elsewhere."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Iterator

import typer

LINE_EVERY_S = 60.0
_BYTES_PER_MB = 1_000_000


class Reporter:
    """Progress of a run in one or more stages, each a pass over the recordings."""

    def __init__(
        self,
        stages: tuple[str, ...],
        unit: str,
        show: Callable[[Reporter], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """unit: MB, or what is counted; clock: s, never steps back."""
        self._stages = stages
        self._number = 0
        self._unit = unit
        self._show = show
        self._clock = clock
        self._began_s = clock()
        self.done = 0
        self.total = 0
        self.scans = 0

    def __call__(self, done: int, total: int, scans: int = 0) -> None:
        """Bytes or scans done, and of all; a smaller number than before begins the next stage."""
        if done < self.done:
            self._number = min(self._number + 1, len(self._stages) - 1)
            self._began_s = self._clock()
        self.done = done
        self.total = total
        self.scans = scans
        self._show(self)

    @property
    def stage(self) -> str:
        """Name of the stage, with its number if there are several."""
        name = self._stages[self._number]
        count = len(self._stages)
        return name if count == 1 else f"{self._number + 1}/{count} {name}"

    @property
    def left_s(self) -> float | None:
        """Time to the end of the stage, by its mean speed; None where it is not known."""
        if not 0 < self.done <= self.total:
            return None
        return (self._clock() - self._began_s) * (self.total - self.done) / self.done

    def amount(self) -> str:
        """Amount done and total amount."""
        if self._unit != "MB":
            return f"{self.done}/{self.total or '?'} {self._unit}"
        text = f"{self.done / _BYTES_PER_MB:.1f}/{self.total / _BYTES_PER_MB:.1f} MB"
        return f"{text}, {self.scans} scans" if self.scans else text

    def line(self) -> str:
        """One line of text."""
        left_s = self.left_s
        left = "" if left_s is None else f", {duration(left_s)} left"
        share = f"{100 * self.done / self.total:.0f} %, " if self.total else ""
        return f"{self.stage}: {share}{self.amount()}{left}"


def duration(seconds: float) -> str:
    """Hours, minutes and seconds: 1:02:03, 2:03."""
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{left:02d}" if hours else f"{minutes}:{left:02d}"


class Lines:
    """Prints the line of a reporter once per minute."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last_s = clock()

    def __call__(self, reporter: Reporter) -> None:
        """Print, if a minute has passed since the last line."""
        now_s = self._clock()
        if now_s - self._last_s >= LINE_EVERY_S:
            self._last_s = now_s
            typer.echo(f"mlbatch: {reporter.line()}", err=True)


@contextlib.contextmanager
def progress_bar(
    *stages: str, unit: str = "MB", is_shown: bool = True, is_verbose: bool = False
) -> Iterator[Reporter | None]:
    """A reporter that shows itself; None where nothing is to be shown.

    is_verbose: lines where stderr is no terminal.
    """
    if not is_shown:
        yield None
    elif sys.stderr.isatty():
        with _bar(stages, unit) as reporter:
            yield reporter
    elif is_verbose:
        yield Reporter(stages, unit, Lines())
    else:
        yield None


@contextlib.contextmanager
def stage_lines(name: str, *, is_shown: bool = True) -> Iterator[None]:
    """Print records of a logger, one per line, as `mlbatch: name: ...`."""
    logger, handler = logging.getLogger(f"mlbatch.{name}"), logging.Handler()
    handler.emit = lambda record: typer.echo(  # type: ignore[method-assign]
        f"mlbatch: {name}: {record.getMessage()}", err=True
    )
    before = logger.level
    if is_shown:
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


@contextlib.contextmanager
def _bar(stages: tuple[str, ...], unit: str) -> Iterator[Reporter]:
    """A bar of rich, which disappears at the end."""
    from rich import progress
    from rich.console import Console

    with progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.TextColumn("{task.fields[amount]}"),
        progress.TextColumn("{task.fields[left]}"),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task(stages[0], total=None, amount="", left="")

        def show(reporter: Reporter) -> None:
            left_s = reporter.left_s
            bar.update(
                task,
                description=reporter.stage,
                completed=reporter.done,
                total=reporter.total or None,
                amount=reporter.amount(),
                left="" if left_s is None else f"ETA {duration(left_s)}",
            )

        yield Reporter(stages, unit, show)
