"""What a command does before its work: it loads what it needs, and spares the collector."""

from __future__ import annotations

from tests.contract.tree import run_python


def test_the_command_line_spares_the_collector() -> None:
    printed = run_python(
        "import atexit, gc, sys\n"
        "from mlbatch.cli import main\n"
        "before = gc.get_threshold()[0]\n"
        # Last in, first out: the command line's own comes before this one.
        "atexit.register(lambda: print(gc.get_threshold()[0] > before, gc.get_freeze_count()))\n"
        "sys.argv[1:] = ['--version']\n"
        "main()\n"
    )
    is_rarer, frozen = printed.splitlines()[-1].split()
    assert is_rarer == "True"
    assert int(frozen)


def test_the_library_leaves_the_collector_alone() -> None:
    printed = run_python(
        "import gc, sys\n"
        "before = gc.get_threshold(), gc.get_freeze_count(), gc.isenabled()\n"
        "import mlbatch.api, mlbatch.cli.app, mlbatch.converting\n"
        "print(before == (gc.get_threshold(), gc.get_freeze_count(), gc.isenabled()))\n"
    )
    assert printed.strip() == "True"
