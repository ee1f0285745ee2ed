"""`mlbatch digest`: golden files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mlbatch.digests import Comparison

# Differences that are printed; the others are counted.
SHOWN = 20


def digest(
    output: Annotated[
        str,
        typer.Argument(
            help="Output of convert: folder of npz or PLY, .mcap, .bag, rosbag2; or its URL."
        ),
    ],
    golden: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Write the golden file (JSON). [default: print it]"),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="Compare with this golden file; exit with 1 where OUTPUT differs."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing golden file.")
    ] = False,
) -> None:
    """Describe an output in a golden file for tests, or compare it with one."""
    from mlbatch.batch.remote import local_output
    from mlbatch.digests import compare, golden_text, read_golden
    from mlbatch.digests import digest as describe
    from mlbatch.errors import UsageError, one_line

    if against is None:
        if golden is not None:
            _check(golden, overwrite=overwrite)
        with local_output(output) as path:
            text = golden_text(describe(path))
        if golden is None:
            typer.echo(text, nl=False)
            return
        _write(golden, text)
        typer.echo(one_line(f"wrote {golden}"))
        return
    if golden is not None:
        raise UsageError("-o: expected either -o or --against, found both; leave one of them out")
    expected = read_golden(against)
    with local_output(output) as path:
        result = compare(expected, describe(path))
    for line in _lines(result):
        typer.echo(one_line(line))
    if not result.ok:
        from mlbatch.errors import RecordingError

        version = expected.get("version", "an earlier version")
        raise RecordingError(
            f"{output}: expected what {against} (made by mlbatch {version}) describes, found "
            f"{len(result.differences)} difference(s); see above, and write the golden file again "
            "if the change is intended"
        )
    typer.echo(one_line(f"{output}: as described in {against}"))


def _lines(result: Comparison) -> list[str]:
    lines = [str(one) for one in result.differences[:SHOWN]]
    left = len(result.differences) - len(lines)
    if left:
        lines.append(f"and {left} more")
    return lines


def _check(path: Path, *, overwrite: bool) -> None:
    """Refuse a golden file that cannot be written, before the output is read."""
    from mlbatch.errors import ExportError

    if not path.parent.is_dir():
        raise ExportError(
            f"{path}: expected a golden file in an existing folder, found none at {path.parent}; "
            "create it (mkdir -p) or choose another"
        )
    if path.is_dir() or (path.exists() and not overwrite):
        raise ExportError(
            f"{path}: expected a new file, found one of this name; compare with it by --against, "
            "or replace it with --overwrite"
        )


def _write(path: Path, text: str) -> None:
    from mlbatch.writers.atomic import write_text

    write_text(path, text)
