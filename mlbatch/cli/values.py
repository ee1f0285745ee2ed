"""The job and target of a conversion, from the values of its options on the command line."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mlbatch.cli.parameters import is_stdout
from mlbatch.cli.run import Target
from mlbatch.errors import UsageError
from mlbatch.pipeline.job import Job, parse_shard
from mlbatch.python.options import (
    ConvertOptions,
    complete,
    output_job,
    output_request,
    session_job,
    window_job,
)

if TYPE_CHECKING:
    from mlbatch.faults import Fault
    from mlbatch.reports.limits import Limit


def job_of(recordings: Sequence[Path], given: Mapping[str, Any]) -> Job:
    """The job of a conversion, from the values of its options."""
    values = complete(_named(given), long_name)
    options = cast(ConvertOptions, values)
    job = window_job(session_job(tuple(recordings), options, long_name), options, long_name)
    shard = values["shard"]
    return replace(
        output_job(job, options, long_name),
        faults=_faults(values["fault"] or ()),
        fault_seed=values["fault_seed"],
        shard=None if shard is None else parse_shard("--shard", shard),
    )


def _named(given: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the names of the table; parameters have names that are no words of Python."""
    return {name.rstrip("_"): value for name, value in given.items()}


def target_of(given: Mapping[str, Any]) -> Target:
    """Where the result of a conversion goes, from the values of its options."""
    values = _named(given)
    if values["accumulate"] is None and values["output"] is None and not values["dry_run"]:
        raise UsageError("-o: expected an output, found none; give -o scans.mcap, or --dry-run")
    if values["resume"] and values["dry_run"]:
        raise UsageError(
            "--resume: expected an output to continue, found --dry-run; give one of them"
        )
    html_scans: int | None = None
    if values["html_scans"] is not None:
        # Not loaded without a page.
        from mlbatch.page import shown_scans

        html_scans = shown_scans(values["html_scans"])
    if html_scans is not None and values["html"] is None:
        raise UsageError(
            "--html-scans: expected a page for the scans, found none; add --html FILE, or leave it "
            "out"
        )
    prints_report = is_stdout(values["report"])
    if prints_report:
        values["report"] = None
    request = output_request(values["output"], cast(ConvertOptions, values), long_name)
    return Target(
        # As typed into a shell.
        request._replace(command=shlex.join(["mlbatch", *sys.argv[1:]])),
        prints_report=prints_report,
        html=values["html"],
        html_scans=html_scans,
        split_jumps=values["on_jump"] == "split",
        limits=_fail_on(values["fail_on"] or (), checks_poses=not values["no_pose_check"]),
        quiet=values["quiet"],
        verbose=values["verbose"],
    )


def _fail_on(texts: Sequence[str], *, checks_poses: bool) -> tuple[Limit, ...]:
    if not texts:
        return ()
    # Not loaded without limits.
    from mlbatch.reports.limits import POSE, parse_limits

    limits = parse_limits(texts)
    for limit in limits:
        if limit.quantity == POSE and not checks_poses:
            raise UsageError(
                f"--fail-on: expected poses to be checked for {limit.text}, found --no-pose-check, "
                "with which it could never fail; leave one out"
            )
    return limits


def long_name(name: str) -> str:
    """An option as typed."""
    return f"--{name.replace('_', '-')}"


def _faults(texts: Sequence[str]) -> tuple[Fault, ...]:
    """`--fault KIND:SENSOR:VALUE`, repeatable."""
    if not texts:
        return ()
    # Not loaded for runs without faults.
    from mlbatch.faults import parse_fault

    return tuple(parse_fault(text) for text in texts)
