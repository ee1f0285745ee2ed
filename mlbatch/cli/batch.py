"""`mlbatch batch`: many sessions."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mlbatch import options
from mlbatch.cli.parameters import parameter, with_parameters

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from mlbatch.batch.driver import Progress
    from mlbatch.batch.plan import Plan
    from mlbatch.batch.session import Option
    from mlbatch.batch.status import SessionStatus


def batch(
    context: typer.Context,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="MANIFEST.yaml|GLOB...",
            help="A manifest, or patterns: a file or folder is a session.",
        ),
    ],
    output: Annotated[
        str,
        typer.Option("-o", "--output", help="Folder (or s3:// URL); one folder per session in it."),
    ],
    rig: Annotated[
        str | None,
        typer.Option("--rig", "-r", help="Rig file (YAML) of all sessions. [default: manifest's]"),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(help="Rig of a public dataset (mlbatch datasets).", metavar="NAME"),
    ] = None,
    workers: Annotated[int, typer.Option(help="Sessions converted at the same time.")] = 1,
    jobs: Annotated[
        str | None,
        typer.Option(
            *("--jobs", "-j"),
            help="Scans made at the same time, by each session. [default: auto; 1 with workers]",
            metavar="N|auto",
        ),
    ] = None,
    retries: Annotated[
        int, typer.Option(help="Further attempts of a session that crashed or was killed.")
    ] = 1,
    part: Annotated[
        str, typer.Option(help="K/N: the Kth of N parts of the sessions, as for an array job.")
    ] = "1/1",
    only: Annotated[
        list[str] | None, typer.Option(help="This session; repeatable.", metavar="NAME")
    ] = None,
    time_limit: Annotated[
        str | None,
        typer.Option(help="Longest time of a session: 2 h, 90 min. [default: manifest's]"),
    ] = None,
    disk_limit: Annotated[
        str | None,
        typer.Option(help="Largest disk use of a session: 50 GB. [default: manifest's]"),
    ] = None,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Print sessions, bytes and hours; keep nothing on disk."),
    ] = False,
    names: Annotated[
        bool, typer.Option("--list", help="Print the names of the sessions, one per line.")
    ] = False,
    fail_fast: Annotated[
        bool, typer.Option("--fail-fast", help="After the first failure begin no other session.")
    ] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Also run sessions that failed before.")
    ] = False,
    no_pages: Annotated[
        bool, typer.Option("--no-pages", help="Do not write a page (HTML) for each session.")
    ] = False,
    scheduler: Annotated[
        str,
        typer.Option(help="Dask scheduler to run the sessions, as tcp://HOST:8786.", metavar="URL"),
    ] = "",
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder for copies of files of object storage.", metavar="DIR"),
    ] = None,
    cache_gb: Annotated[float | None, typer.Option(help="Ignored.", hidden=True)] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No table, no progress.")] = False,
    **values: Any,
) -> None:
    """Convert many sessions, a process each; a second run does what is missing or changed."""
    from mlbatch.batch.driver import BATCH_LOG, Batch
    from mlbatch.batch.manifest import Common, chosen, sessions_of
    from mlbatch.batch.plan import plan_of
    from mlbatch.batch.record import KNOWN_BAD
    from mlbatch.batch.remote import default_cache
    from mlbatch.batch.session import is_url, read_limits
    from mlbatch.batch.task import tasks_of
    from mlbatch.cli import EXIT_LIMIT
    from mlbatch.cli.summary import say
    from mlbatch.pipeline.interrupts import interruptible
    from mlbatch.pipeline.job import parse_shard
    from mlbatch.rig.rig import read_rig

    _check_counts(workers=workers, retries=retries)
    if cache_gb is not None:
        say("--cache-gb is ignored, since copies are removed when their session has ended")
    jobs = _jobs(jobs, workers)
    numbers = parse_shard("--part", part)
    limits = read_limits(time_limit, disk_limit, ("--time-limit", "--disk-limit"))
    if dataset is not None:
        from mlbatch.rig.recipes import rig_of

        rig = str(rig_of(None if rig is None else Path(rig), dataset))
    given = Common(rig, tuple(_given(context, values, jobs)), limits=limits)
    if rig is not None and dataset is None and not is_url(rig):
        # A mistake in it would fail every session.
        read_rig(Path(rig))
    sessions = chosen(sessions_of(sources, given, say), only or (), numbers)
    if names:
        for session in sessions:
            typer.echo(session.name)
        return
    with interruptible():
        tasks = tasks_of(
            *(sessions, output, (cache or default_cache()).absolute()),
            retries=retries,
            pages=not no_pages,
        )
        if plan:
            _print_plan(plan_of(tasks, workers, retry_failed=retry_failed))
            return
        with _progress(len(tasks), quiet=quiet) as progress:
            found = Batch(
                workers=workers,
                fail_fast=fail_fast,
                retry_failed=retry_failed,
                log=None if is_url(output) else Path(output) / BATCH_LOG,
                scheduler=scheduler,
                progress=progress,
            ).run(tasks)
    if not quiet:
        print_status(found, ("done", "skipped", "failed", KNOWN_BAD), len(tasks))
    if any(one.is_failed for one in found):
        raise typer.Exit(EXIT_LIMIT)


# -- options of `convert` ---------------------------------------------------------------------


def _jobs(asked: str | None, workers: int) -> str | None:
    """Jobs of each session; None: as `convert` decides, or its rig."""
    from mlbatch.writers.threads import parse_jobs

    if asked is None:
        # Several sessions use all cores already.
        return None if workers == 1 else "1"
    parse_jobs("--jobs", asked)
    return asked


def _given(context: typer.Context, given: dict[str, Any], jobs: str | None) -> Iterator[Option]:
    """The options of `convert` on this command line."""
    from mlbatch.batch.session import Option

    for name, value in given.items():
        source = context.get_parameter_source(name)
        if source is None or source.name == "DEFAULT":
            continue
        long_name = options.BY_NAME[name.rstrip("_")].long
        if isinstance(value, bool):
            yield Option(long_name)
        else:
            several = value if isinstance(value, (list, tuple)) else [value]
            yield Option(long_name, tuple(map(str, several)))
    if jobs is not None:
        yield Option("--jobs", (jobs,))


def _check_counts(**counts: int) -> None:
    from mlbatch.errors import UsageError

    for name, count in counts.items():
        least = 0 if name == "retries" else 1
        if not least <= count <= 1000:
            raise UsageError(f"--{name}: expected {least} to 1000, found {count}; correct it")


with_parameters(batch, map(parameter, options.BATCH))


# -- output -----------------------------------------------------------------------------------


@contextlib.contextmanager
def _progress(count: int, *, quiet: bool) -> Iterator[Progress]:
    """A bar over the sessions with remaining time, on a terminal; failures as lines."""
    from mlbatch.cli.progress import progress_bar
    from mlbatch.cli.summary import say

    with progress_bar("sessions", unit="sessions", is_shown=not quiet) as bar:
        done = itertools.count()
        if bar is not None:
            bar(next(done), count)

        def ended(one: SessionStatus) -> None:
            if one.is_failed and not one.is_earlier:
                say(f"session {one.name}: {one.reason}")
            if bar is not None:
                bar(next(done), count)

        yield ended


def print_status(sessions: Sequence[SessionStatus], words: Sequence[str], count: int) -> None:
    """Print a table of sessions, and how many are in each state; count: with those not begun."""
    from mlbatch.batch.record import KNOWN_BAD
    from mlbatch.batch.status import HEAD
    from mlbatch.cli.tables import table_lines

    for line in table_lines([HEAD, *(one.row for one in sessions)]) if sessions else ():
        typer.echo(line)
    found = [one.word for one in sessions]
    counts = [f"{found.count(word)} {word}" for word in words if word != KNOWN_BAD or word in found]
    if len(sessions) < count:
        counts.append(f"{count - len(sessions)} not begun (--fail-fast)")
    typer.echo(f"{count} sessions: {', '.join(counts)}")


def _print_plan(plan: Plan) -> None:
    from mlbatch.batch.status import bytes_text, duration_text
    from mlbatch.cli.tables import table_lines

    rows = [("session", "state", "recordings", "bytes", "")]
    for one in plan.sessions:
        size = "?" if one.bytes is None else bytes_text(one.bytes)
        rows.append((one.name, one.word, str(one.inputs), size, one.problem))
    for line in table_lines(rows):
        typer.echo(line)
    typer.echo(
        f"{len(plan.to_run)} of {len(plan.sessions)} sessions to convert: "
        f"{bytes_text(plan.bytes_in)} in, about {bytes_text(plan.bytes_out)} out, "
        f"about {duration_text(plan.seconds)} with {plan.workers} worker(s) ({plan.source})"
    )
