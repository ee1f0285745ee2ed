"""The command line: options to calls, errors to exit codes; the only place that prints."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from typing import NoReturn, TextIO

from mlbatch.errors import Interrupted, MlbatchError, UsageError, system_error

# Otherwise numpy's linear algebra, which is not used, starts a thread on every core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Allocations between collections of cycles. A command loads some ten thousand objects that live to
# its end: the collector would traverse them repeatedly, and once more at exit.
_BETWEEN_COLLECTIONS = 100_000

EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_LIMIT = 3
EXIT_INTERRUPTED = 130


def main() -> None:
    """Run the command line; exit codes: docs/commands.md."""
    gc.set_threshold(_BETWEEN_COLLECTIONS)
    atexit.register(gc.freeze)
    _open_streams()
    try:
        from mlbatch.cli.app import command_line

        code = command_line(*sys.argv[1:2])(prog_name="mlbatch", standalone_mode=False)
        if code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        sys.stdout.flush()
        sys.exit(code)
    except UsageError as err:
        _fail(str(err), EXIT_USAGE)
    except Interrupted as err:
        _fail(str(err), EXIT_INTERRUPTED)
    except MlbatchError as err:
        _fail(str(err), EXIT_ERROR)
    except KeyboardInterrupt:
        _fail("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output closed it: there is nowhere to print to.
        _leave(sys.stdout)
        sys.exit(EXIT_ERROR)
    except OSError as err:
        if os.environ.get("MLBATCH_TRACEBACK"):
            raise
        if err.filename is None:
            _leave(sys.stdout)
        _fail(str(system_error(err)), EXIT_ERROR)
    except MemoryError:
        _fail("out of memory; use a smaller --max-wait, or convert a part with --end", EXIT_ERROR)
    except Exception as err:
        if isinstance(err.__cause__, KeyboardInterrupt):
            # While a class was made: Python 3.11 and older raise it as a RuntimeError.
            _fail("interrupted", EXIT_INTERRUPTED)
        usage = _usage(err)
        if usage:
            _fail(f"{usage}; see `mlbatch --help`", EXIT_USAGE)
        if os.environ.get("MLBATCH_TRACEBACK"):
            raise
        _fail(
            f"internal error, please report it: {type(err).__name__}: {err} "
            "(MLBATCH_TRACEBACK=1 shows where)",
            EXIT_ERROR,
        )


def _open_streams() -> None:
    """Open /dev/null for each standard stream that is closed; else a file would be taken for it."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def _leave(stream: TextIO) -> None:
    """Give up a stream that takes no more; what it still holds would be written at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _usage(err: Exception) -> str:
    """Message of a usage error of typer; "" for other errors."""
    import typer

    # typer exports only a leaf of its usage errors; the module of their root changes with versions.
    if not isinstance(err, typer.BadParameter.__mro__[1]):
        return ""
    return str(getattr(err, "format_message", err.__str__)()).rstrip(".")


def _fail(message: str, code: int) -> NoReturn:
    line = " ".join(message.split())
    try:
        print(f"mlbatch: error: {line}", file=sys.stderr, flush=True)
    except OSError:
        # A full disk as standard error: the exit code is what is left.
        _leave(sys.stderr)
    sys.exit(code)
