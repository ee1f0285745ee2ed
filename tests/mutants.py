"""Mutation score: how many small changes of the package its tests notice (`make mutants`).

A seeded sample of mutants, each one changed operator, number, condition or a statement left out, in
a copy of the repository. The tests of a package are the folder of its name; of these run the ones
that execute the mutated lines. `--again` tests the mutants of earlier results (`--save`) in later
sources, where it finds them by the text of their lines.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE
from typing import Any, NamedTuple

from coverage import CoverageData

ROOT = Path(__file__).parents[1]
PACKAGES = ("batching", "decode", "sensors", "clocks", "readers")
# A mutant that loops forever: far above the slowdown of a loaded machine.
TIMEOUT_FACTOR, TIMEOUT_LEAST_S = 15.0, 600.0

_PAIRS = "Lt LtE,Gt GtE,Eq NotEq,Is IsNot,In NotIn,Add Sub,And Or,BitAnd BitOr,LShift RShift"
_SWAPS: dict[type, Any] = {ast.Mult: ast.FloorDiv, ast.FloorDiv: ast.Mult}
_SWAPS |= {ast.Div: ast.Mult, ast.Mod: ast.FloorDiv}
for _one, _other in (pair.split() for pair in _PAIRS.split(",")):
    _SWAPS[getattr(ast, _one)] = getattr(ast, _other)
    _SWAPS[getattr(ast, _other)] = getattr(ast, _one)
# Annotations and texts of errors are not run, or checked elsewhere.
_SKIPPED = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)
_LIVES = "survived"


class Mutant(NamedTuple):
    """A replacement of `before`, whole lines from `line` (from 1) on, by `after`."""

    path: str
    line: int
    before: str
    after: str


def _changed(node: ast.AST) -> ast.AST | None:
    """The mutated node; None if none of the rules fits."""
    match node:
        case ast.Compare(left, [first, *ops], others) if type(first) in _SWAPS:
            return ast.Compare(left, [_SWAPS[type(first)](), *ops], others)
        case ast.BinOp(left, op, right) if type(op) in _SWAPS:
            return ast.BinOp(left, _SWAPS[type(op)](), right)
        case ast.BoolOp(op, values):
            return ast.BoolOp(_SWAPS[type(op)](), values)
        case ast.UnaryOp(ast.Not(), operand):
            return operand
        case ast.Constant(bool(value)):
            return ast.Constant(not value)
        case ast.Constant(int(value) | float(value)):
            return ast.Constant(value + 1)
        case ast.IfExp(test, body, orelse):
            return ast.IfExp(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.Expr(ast.Call()):
            return ast.Pass()
        case ast.Break():
            return ast.Continue()
        case ast.Continue():
            return ast.Break()
    return None


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run, in the order of the source."""
    if isinstance(node, _SKIPPED):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "decorator_list"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _nodes(child)


def mutants(path: Path) -> Iterator[Mutant]:
    """All mutants of a module."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for node in _nodes(ast.parse(text)):
        changed = _changed(node)
        if changed is None or not isinstance(node, ast.expr | ast.stmt):
            continue
        before = lines[node.lineno - 1 : node.end_lineno]
        # Columns are bytes.
        head = before[0].encode()[: node.col_offset].decode()
        tail = before[-1].encode()[node.end_col_offset :].decode()
        new = ast.unparse(ast.fix_missing_locations(changed))
        new = f"({new})" if isinstance(node, ast.expr) else new
        yield Mutant(str(path.relative_to(ROOT)), node.lineno, "\n".join(before), head + new + tail)


def sample(count: int, seed: int) -> list[Mutant]:
    """A seeded sample, as many of each package."""
    chosen = random.Random(seed)
    found = []
    for package in PACKAGES:
        paths = sorted((ROOT / "mlbatch" / package).rglob("*.py"))
        every = [one for path in paths for one in mutants(path)]
        found += chosen.sample(every, -(-count // len(PACKAGES)))
    return found[:count]


class Tests:
    """The tests of a package in a copy of the last commit, and the lines that each executes."""

    def __init__(self, tree: Path, package: str) -> None:
        """Run them all."""
        self.tree = tree
        self.folder = f"tests/{package}"
        began_s = time.monotonic()
        if self.run(self.folder, "--cov=mlbatch", "--cov-context=test", "--cov-report=") != _LIVES:
            sys.exit(f"mutants: expected {self.folder} to pass without a mutant")
        self.timeout_s = TIMEOUT_LEAST_S + TIMEOUT_FACTOR * (time.monotonic() - began_s)
        self.data = CoverageData(str(tree / ".coverage"))
        self.data.read()

    def run(self, *words: str, timeout_s: float | None = None) -> str:
        """`survived`, `killed` or `timeout`."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *words]
        shell = os.environ | {"PYTHONPATH": str(self.tree), "OMP_NUM_THREADS": "1"}
        try:
            done = subprocess.run(
                command, cwd=self.tree, env=shell, capture_output=True, timeout=timeout_s
            )
        except subprocess.TimeoutExpired:
            return "timeout"
        return "killed" if done.returncode else _LIVES

    def outcome(self, mutant: Mutant) -> str:
        """That of a mutant; `gone`: no such line any more; `not run`: no test executes it."""
        path = self.tree / mutant.path
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        lines, before = text.split("\n"), mutant.before.split("\n")
        starts = [n for n in range(len(lines)) if lines[n : n + len(before)] == before]
        if not starts:
            return "gone"
        at = min(starts, key=lambda start: abs(start + 1 - mutant.line))
        executed = self.data.contexts_by_lineno(str(path))
        # Coverage notes the first line of a statement.
        around = [
            range(node.lineno, (node.end_lineno or node.lineno) + 1)
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.stmt) and node.lineno <= at + 1 <= (node.end_lineno or 0)
        ]
        contexts = {one for n in min(around, key=len) for one in executed.get(n, [])}
        if not contexts:
            return "not run"
        # Lines of a module's body run before any test.
        tests = sorted({one.partition("|")[0] for one in contexts} - {""}) or [self.folder]
        # Bytecode is chosen by size and second of the source, which may both be the same.
        for cached in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
            cached.unlink()
        mutated = [*lines[:at], mutant.after, *lines[at + len(before) :]]
        path.write_text("\n".join(mutated), encoding="utf-8")
        found = self.run(*tests, timeout_s=self.timeout_s)
        path.write_text(text, encoding="utf-8")
        return found


def main() -> None:
    """Test the mutants, print one line for each and the score."""
    options = argparse.ArgumentParser("python -m tests.mutants", description=__doc__)
    options.add_argument("--count", type=int, default=60)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--save", type=Path, help="file of results, JSON")
    options.add_argument("--again", type=Path, help="test the mutants of an earlier file")
    given = options.parse_args()
    chosen = sample(given.count, given.seed)
    if given.again:
        earlier = json.loads(given.again.read_text(encoding="utf-8"))
        chosen = [Mutant(*mutant) for mutant, _ in earlier]
    rows: list[tuple[Mutant, str]] = []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder).resolve()
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, stdout=PIPE, check=True)
        subprocess.run(["tar", "-x"], cwd=tree, input=archive.stdout, check=True)
        for library in (ROOT / "mlbatch/native").glob("*.so"):
            shutil.copy(library, tree / "mlbatch/native")
        tests: dict[str, Tests] = {}
        for mutant in chosen:
            package = Path(mutant.path).parts[1]
            if package not in tests:
                tests[package] = Tests(tree, package)
            rows.append((mutant, tests[package].outcome(mutant)))
            print(f"{rows[-1][1]}: {mutant.path}:{mutant.line}")
            print(f"  - {mutant.before.strip()}\n  + {mutant.after.strip()}", flush=True)
    if given.save:
        given.save.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(dict(Counter(outcome for _, outcome in rows)))


if __name__ == "__main__":
    main()
