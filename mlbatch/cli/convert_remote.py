"""`mlbatch convert` with URLs: inputs are copied to the cache, the output is uploaded.

Not a part of `convert.py`: most runs have no URL.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mlbatch.cli.summary import say
from mlbatch.errors import UsageError

if TYPE_CHECKING:
    from mlbatch.batch.cache import Cache

_OUTPUT = ("-o", "--output")
# Files that are written apart from the output.
_LOCAL_ONLY = ("--report", "--html")


def convert_remote(words: list[str]) -> None:
    """Run `mlbatch convert` with these words; raises typer.Exit with its exit code.

    words: of the command line, after `convert`.
    """
    from mlbatch.batch.cache import Cache
    from mlbatch.pipeline.interrupts import interruptible

    cache = Cache.of(None, float("inf"))
    words = _split_words(words)
    target = ""
    urls = []
    for before, word in zip(["", *words], words, strict=False):
        if "://" not in word:
            continue
        if before in _LOCAL_ONLY:
            raise UsageError(f"{before}: expected a local file, found {word}; give a path")
        if before in _OUTPUT:
            target = word
        else:
            urls.append(word)
    _check_target(target, words)
    with interruptible(), cache.staged(urls) as copies:
        for url, path in copies.items():
            say(f"{url}: copied to {path} ({path.stat().st_size} bytes)")
        local = {url: str(path) for url, path in copies.items()}
        folder = cache.output(target)
        if target:
            name = target.rstrip("/").rpartition("/")[2]
            folder.mkdir(parents=True, exist_ok=True)
            local[target] = str(folder / name)
        code = _run([local.get(word, word) for word in words])
        if target and code in (0, 3):
            _upload(folder, target, cache)
    if code:
        raise typer.Exit(code)


def _check_target(target: str, words: list[str]) -> None:
    """Refuse to replace an output without --overwrite or --resume."""
    if not target or "--overwrite" in words or "--resume" in words:
        return
    from mlbatch.batch.remote import listed, size_of
    from mlbatch.errors import ExportError

    if size_of(target) is not None or listed(target):
        raise ExportError(
            f"{target}: expected a new output, found an existing one; choose another or --overwrite"
        )


def _split_words(words: list[str]) -> list[str]:
    """Options with `=` as two words."""
    found = []
    for word in words:
        name, equals, value = word.partition("=")
        found += [name, value] if equals and name.startswith("--") and "://" in value else [word]
    return found


def _run(words: list[str]) -> int:
    command = [sys.executable, "-m", "mlbatch.cli.child", "convert", *words]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        return process.wait()


def _upload(folder: Path, target: str, cache: Cache) -> None:
    """Upload an output with the files next to it, the output itself last, and remove it here."""
    import shutil

    from mlbatch.batch.remote import upload

    root = target.rstrip("/").rpartition("/")[0]
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    name = target.rstrip("/").rpartition("/")[2]
    for path in sorted(files, key=lambda path: path.name == name):
        url = f"{root}/{path.relative_to(folder).as_posix()}"
        upload(path, url)
        say(f"uploaded {url} ({path.stat().st_size} bytes)")
    shutil.rmtree(folder)
