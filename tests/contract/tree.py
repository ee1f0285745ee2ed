"""The source tree as the rules see it: modules, their imports, their functions."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "mlbatch"
# Formats of readers and writers, sensors of vendors.
PLUGIN = re.compile(r"(?:readers|writers)\.formats\.\w+|sensors\.\w+\.sensor")


@dataclass(frozen=True, slots=True)
class Module:
    """One file of the package; name: dotted, without `mlbatch.` (the root is empty)."""

    path: Path
    name: str

    @property
    def tree(self) -> ast.Module:
        """What the file says."""
        return _parsed(self.path)

    @property
    def top(self) -> str:
        """The first part of the name: a module or package right under mlbatch."""
        return self.name.partition(".")[0]


@dataclass(frozen=True, slots=True)
class Import:
    """An import of a module of the package, anywhere in a file."""

    target: str
    line: int
    only_for_types: bool
    when_called: bool


@lru_cache(maxsize=1)
def modules() -> tuple[Module, ...]:
    """All modules of the package."""
    return tuple(_module(path) for path in sorted(PACKAGE.rglob("*.py")))


@lru_cache(maxsize=1)
def plugins() -> tuple[Module, ...]:
    """Modules that are found by their place, and named by no other."""
    return tuple(module for module in modules() if PLUGIN.fullmatch(module.name))


def _module(path: Path) -> Module:
    parts = list(path.relative_to(PACKAGE).with_suffix("").parts)
    if parts[-1] == "__init__":
        parts.pop()
    return Module(path, ".".join(parts))


@cache
def _parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(module: Module, names: frozenset[str]) -> tuple[Import, ...]:
    """Imports from the package; `names`: all its modules, unlike what they define."""
    return tuple(_imports(module, names))


def _imports(module: Module, names: frozenset[str]) -> Iterator[Import]:
    guarded, called = _inside(module.tree, _is_guard), _inside(module.tree, _is_function)
    for node in ast.walk(module.tree):
        for target in _targets(node, module, names):
            line = getattr(node, "lineno", 0)
            yield Import(target, line, id(node) in guarded, id(node) in called)


def _inside(tree: ast.Module, chosen: Callable[[ast.AST], bool]) -> set[int]:
    """Identities of all nodes inside the chosen ones."""
    outer = [node for node in ast.walk(tree) if chosen(node)]
    return {id(inner) for node in outer for inner in ast.walk(node)}


def _is_guard(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def _is_function(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef)


def _targets(node: ast.AST, module: Module, names: frozenset[str]) -> Iterator[str]:
    dotted: list[str] = []
    if isinstance(node, ast.Import):
        dotted = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"{module.path}:{node.lineno}: relative import"
        base = node.module or ""
        for alias in node.names:
            inner = f"{base}.{alias.name}"
            dotted.append(inner if inner.removeprefix("mlbatch.") in names else base)
    for name in dotted:
        if name == "mlbatch" or name.startswith("mlbatch."):
            yield name.removeprefix("mlbatch").removeprefix(".")


def run_python(code: str, cwd: Path = ROOT) -> str:
    """What a fresh interpreter prints; the repository is importable there."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "MLBATCH_TRACEBACK": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_mlbatch(arguments: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, its output as text."""
    return subprocess.run(
        [sys.executable, "-m", "mlbatch", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        check=False,
    )
