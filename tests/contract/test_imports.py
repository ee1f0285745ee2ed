"""Imports run one way, and plug-ins are only found by name ."""

from __future__ import annotations

import re
from collections.abc import Iterator

from tests.contract.tree import PACKAGE, ROOT, Import, Module, imports, modules, plugins

# From top to bottom: a package imports from its own modules and from lower floors.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("__main__",),
    ("cli",),
    ("batch",),
    ("api",),
    ("comparison", "simulate"),
    ("page",),
    ("python", "digests"),
    ("pipeline",),
    ("discovery", "verification"),
    ("outputs",),
    ("readers", "sensors", "writers", "faults"),
    ("decode", "batching"),
    ("poses",),
    ("reports", "rig", "clocks", "motion"),
    ("lidar", "frames", "ros"),
    ("types",),
    ("native",),
    ("arrays", "units", "entry_points", "options"),
    # "": the package itself, with its version; it loads the rest on demand.
    ("errors", "bounded", ""),
)
FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}
# A module in the folder of a vendor.
VENDOR = re.compile(r"sensors\.(\w+)\.(?=\w)")
MODULES = modules()
NAMES = frozenset(module.name for module in MODULES)


def _imports() -> Iterator[tuple[Module, Import]]:
    for module in MODULES:
        for found in imports(module, NAMES):
            yield module, found


def test_every_package_has_its_floor() -> None:
    assert {module.top for module in MODULES} <= set(FLOOR)


def test_the_map_draws_these_floors() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    (drawn,) = re.findall(r"^    (cli > .*?)\n\n", page, re.MULTILINE | re.DOTALL)
    floors = [set(re.findall(r"\w+", floor)) for floor in drawn.split(">")]
    assert floors == [set(names) - {""} for names in FLOORS[1:]]


def test_imports_go_down() -> None:
    for module, found in _imports():
        top = found.target.partition(".")[0]
        if module.name == "":
            assert found.only_for_types, f"{module.path}:{found.line}: the root must load nothing"
            continue
        assert top == module.top or FLOOR[top] > FLOOR[module.top], (
            f"{module.path}:{found.line}: {module.name} imports {found.target}, "
            "which is not on a lower floor"
        )


def test_modules_can_be_loaded_one_after_the_other() -> None:
    """Only what types need, or a function when it is called, may close a circle of imports."""
    left = {
        module.name: {
            found.target
            for found in imports(module, NAMES)
            if not found.only_for_types and not found.when_called
        }
        - {"", module.name}
        for module in MODULES
    }
    while left:
        ready = [name for name, needed in left.items() if not needed & set(left)]
        assert ready, f"circle: {sorted(left)}"
        for name in ready:
            del left[name]


def test_verify_knows_nothing_of_the_writers() -> None:
    """A fault of a writer must not be hidden by the same fault in a check."""
    by_name = {module.name: module for module in MODULES}
    reached = {name for name in NAMES if name.partition(".")[0] == "verification"}
    left = list(reached)
    while left:
        for found in imports(by_name[left.pop()], NAMES):
            if found.target not in reached and not found.only_for_types:
                reached.add(found.target)
                left.append(found.target)
    assert not [name for name in reached if name.partition(".")[0] in ("writers", "pipeline")]


def test_nobody_names_a_plugin() -> None:
    found_by_name = {plugin.name for plugin in plugins()}
    for module, found in _imports():
        assert found.target not in found_by_name, f"{module.path}:{found.line}: {found.target}"


def test_vendors_know_nothing_of_each_other() -> None:
    """Modules of a vendor's folder are imported by that folder and the vendor's simulator alone."""
    for module, found in _imports():
        vendor = VENDOR.match(found.target)
        if vendor is not None:
            folders = vendor[0], f"simulate.{vendor[1]}."
            assert module.name.startswith(folders), f"{module.path}:{found.line}: {found.target}"


def test_no_module_is_private() -> None:
    """A module that only one other imports is a part of that one."""
    private = re.compile(r"(?:^|\.)_(?!_main__)")
    found = [name for name in NAMES if private.search(name)]
    assert sorted(found) == []


def test_the_root_has_nine_modules() -> None:
    found = {path.stem for path in PACKAGE.glob("*.py")}
    base = {"types", "arrays", "units", "errors", "bounded", "options"}
    assert found == {"__init__", "__main__", "api"} | base
