"""`mlbatch convert` with URLs: inputs are copied to a work folder, the output is uploaded.

Not a part of `convert.py`: most runs have no URL.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Sequence
from pathlib import Path

import typer

from mlbatch.batch import remote
from mlbatch.batch.session import is_url
from mlbatch.cli import EXIT_LIMIT
from mlbatch.cli.summary import say
from mlbatch.errors import ExportError, RecordingError, UsageError
from mlbatch.rig.recipes import rig_of

_OUTPUT = ("-o", "--output")
# Files that are written apart from the output.
_LOCAL_ONLY = ("--report", "--html", "--accumulate")


def convert_remote(given: Sequence[str]) -> None:
    """Run `mlbatch convert` with the words of a command line after `convert`."""
    from mlbatch.pipeline.interrupts import interruptible

    words = [part for word in given for part in _split(word)]
    places = {word: before for before, word in zip(["", *words], words, strict=False)}
    urls = list(filter(is_url, places))
    for url in urls:
        if places[url] in _LOCAL_ONLY:
            raise UsageError(f"{places[url]}: expected a local file, found {url}; give a path")
    outputs = [word for word, before in places.items() if before in _OUTPUT]
    target = next(filter(is_url, outputs), "")
    if target and not {"--overwrite", "--resume"} & {*words}:
        _check_new(target)
    cache = remote.default_cache().absolute()
    inputs = [url for url in urls if url != target]
    folder = cache / "outputs" / remote.digest_of(target)
    with interruptible(), remote.fetched(inputs, cache, outputs or words, _rig(words)) as copies:
        for url, path in copies.items():
            say(f"{url}: copied to {path} ({Path(path).stat().st_size} bytes)")
        if target:
            folder.mkdir(parents=True, exist_ok=True)
            copies[target] = str(folder / target.rstrip("/").rpartition("/")[2])
        code = _run([copies.get(word, word) for word in words])
        if target and code in (0, EXIT_LIMIT):
            _upload(folder, target)
    if code:
        raise typer.Exit(code)


def _split(word: str) -> Sequence[str]:
    """An option with `=` and a URL as two words."""
    name, _, value = word.partition("=")
    return (name, value) if name.startswith("--") and is_url(value) else (word,)


def _rig(words: Sequence[str]) -> Path | None:
    """The local rig, or the recipe of a dataset."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, is_joined, own = word.partition("=")
        value = own if is_joined else following
        if name == "--dataset":
            return rig_of(None, value)
        if name in ("--rig", "-r") and not is_url(value):
            return Path(value)
    return None


def _check_new(target: str) -> None:
    """Raise ExportError where an output would be replaced."""
    with contextlib.suppress(RecordingError):
        if not remote.listed(target):
            remote.head(target)
        raise ExportError(
            f"{target}: expected a new output, found an existing one; choose another or --overwrite"
        )


def _run(words: Sequence[str]) -> int:
    """The command with local paths; the parser also takes the options that a rig keeps."""
    from mlbatch.cli.app import command_line

    command = command_line("convert")
    return command(["convert", *words], prog_name="mlbatch", standalone_mode=False) or 0


def _upload(folder: Path, target: str) -> None:
    """Upload an output with the files next to it, the output itself last, and remove it here."""
    root, _, name = target.rstrip("/").rpartition("/")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in sorted(files, key=lambda path: path.name == name):
        url = f"{root}/{path.relative_to(folder).as_posix()}"
        remote.upload(path, url)
        say(f"uploaded {url} ({path.stat().st_size} bytes)")
    shutil.rmtree(folder)
