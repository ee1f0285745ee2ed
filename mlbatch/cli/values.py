"""Option values from text, and the job and target that they make."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mlbatch.cli.parameters import is_stdout
from mlbatch.cli.run import Target
from mlbatch.errors import UsageError
from mlbatch.options import INSTANTS
from mlbatch.pipeline.job import Job, check_max_bag_s
from mlbatch.pipeline.output import OutputRequest
from mlbatch.python.options import ScanOptions, choice, session_job, window_job
from mlbatch.sensors import DECODE_OPTIONS
from mlbatch.units import parse_rate
from mlbatch.writers import parse_jobs

if TYPE_CHECKING:
    from mlbatch.faults import Fault
    from mlbatch.pipeline.job import Shard
    from mlbatch.reports.limits import Limit


def job_of(recordings: Sequence[Path], values: Mapping[str, Any]) -> Job:
    """The job of a conversion, from the values of its options."""
    # An option that is not given is left out, as in Python.
    given = {name: value for name, value in values.items() if value is not None}
    # Options with another form than in Python.
    given["decode"] = decode_options(values["decode"] or ())
    given["rate"] = None if values["rate"] is None else rate(values["rate"])
    given["deskew"] = values["deskew"] or None
    given["exclude_boxes"] = tuple(box_m(text) for text in values["exclude_box"] or ())
    options = cast(ScanOptions, given)
    job = window_job(session_job(tuple(recordings), options, long_name), options, long_name)
    return replace(
        job,
        stamp=choice("--stamp", values["stamp"], INSTANTS),
        faults=faults(values["fault"] or ()),
        fault_seed=seed(values["fault_seed"]),
        passed=tuple(values["pass_"] or ()),
        max_bag_s=check_max_bag_s("--max-bag-duration", values["max_bag_duration"]),
        shard=shard(values["shard"]),
    )


def target_of(values: Mapping[str, Any]) -> Target:
    """Where the result of a conversion goes, from the values of its options."""
    on_jump = choice("--on-jump", values["on_jump"], ("error", "split"))
    if values["accumulate"] is None:
        output(values["output"], dry_run=values["dry_run"])
    report = values["report"]
    resume(values["resume"], dry_run=values["dry_run"])
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
    names = (
        *("output", "format", "point_layout", "compression", "ply_style", "dry_run"),
        *("overwrite", "resume", "accumulate", "voxel", "crs"),
    )
    request = OutputRequest(
        **{name: values[name] for name in names},
        jobs=parse_jobs("--jobs", values["jobs"]),
        report=None if is_stdout(report) else report,
        fsync=not values["no_fsync"],
        # As typed into a shell.
        command=shlex.join(["mlbatch", *sys.argv[1:]]),
    )
    return Target(
        request,
        prints_report=is_stdout(report),
        html=values["html"],
        html_scans=html_scans,
        split_jumps=on_jump == "split",
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


def rate(text: str) -> Fraction:
    """`--rate`, exactly the number in the text."""
    try:
        return parse_rate(text)
    except UsageError as err:
        raise UsageError(f"--{err}") from err


def box_m(text: str) -> tuple[float, ...]:
    """`--exclude-box x0,y0,z0,x1,y1,z1`, metres in the body frame."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    ordered = len(values) == 6 and all(a < b for a, b in zip(values[:3], values[3:], strict=True))
    if not ordered:
        raise UsageError(
            f"--exclude-box: expected x0,y0,z0,x1,y1,z1 in metres with x0 < x1, y0 < y1, z0 < z1, "
            f"found {text!r}; write --exclude-box=-1,-1,0,1,1,2"
        )
    return values


def decode_options(texts: Sequence[str]) -> dict[str, str]:
    """`--decode KEY=VALUE`, repeatable."""
    options = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if key not in DECODE_OPTIONS:
            raise UsageError(
                f"--decode: expected one of {', '.join(DECODE_OPTIONS)}, found {key!r}; "
                "write --decode crc=check"
            )
        if not sign or value not in DECODE_OPTIONS[key]:
            raise UsageError(
                f"--decode {key}: expected {' or '.join(DECODE_OPTIONS[key])}, found {value!r}; "
                f"write --decode {key}={DECODE_OPTIONS[key][0]}"
            )
        options[key] = value
    return options


def faults(texts: Sequence[str]) -> tuple[Fault, ...]:
    """`--fault KIND:SENSOR:VALUE`, repeatable."""
    if not texts:
        return ()
    # Not loaded for runs without faults.
    from mlbatch.faults import parse_fault

    return tuple(parse_fault(text) for text in texts)


def shard(text: str | None) -> Shard | None:
    """`--shard K/N`."""
    if text is None:
        return None
    # Not loaded for runs without shards.
    from mlbatch.pipeline.job import parse_shard

    return parse_shard(text)


def seed(number: int) -> int:
    """`--fault-seed`, a whole number from 0."""
    if number < 0:
        raise UsageError(
            f"--fault-seed: expected a whole number from 0, found {number}; correct it"
        )
    return number


def output(path: Path | None, *, dry_run: bool) -> None:
    """`-o`, required unless it is a dry run."""
    if path is None and not dry_run:
        raise UsageError("-o: expected an output, found none; give -o scans.mcap, or --dry-run")


def resume(is_given: bool, *, dry_run: bool) -> None:
    """`--resume`, which a dry run cannot have: it leaves no output."""
    if is_given and dry_run:
        raise UsageError(
            "--resume: expected an output to continue, found --dry-run; give one of them"
        )
