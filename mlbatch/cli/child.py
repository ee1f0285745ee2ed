"""`mlbatch convert` as the process of a session; it ends with the process that started it.

    python -m mlbatch.cli.child convert ...

Its standard input is a pipe to that process, which nothing is written to: the pipe closes when that
process ends, also by SIGKILL. Without this, conversions would continue that nobody waits for.
"""

from __future__ import annotations

import os
import signal
import threading

from mlbatch.cli import main


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    # Finished files are safe: `--resume` continues after it.
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    main()
