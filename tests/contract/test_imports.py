"""Imports run one way, and plug-ins are only found by name (STYLE.md, section 2)."""

from __future__ import annotations

import pytest

from tests.contract.tree import PLUGIN_PACKAGES, Module, imports, modules, plugins

# From left to right: a module imports modules of its own group, and groups of later lines.
LAYERS: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("cli", "__main__"),),
    (("api",), ("compare",)),
    (("converting",),),
    (("resume", "_resume_identity", "_resume_state"),),
    (("pipeline", "accounts"), ("survey",)),
    (("timekeeping",), ("decoding",)),
    (("assembly",),),
    (("feeding",), ("job",)),
    (("inertial",), ("passing",), ("discover",)),
    (("looking",), ("mounting",), ("clipping",), ("matching", "_rigged")),
    (("learning",), ("sharing",)),
    (
        ("readers",),
        ("sensors",),
        ("batching",),
        (
            *("decode", "compiled", "compiled_outline", "_compiled_tables"),
            *("outline", "tiles", "projection", "buffers"),
        ),
        ("writers",),
        ("report",),
        ("streams",),
    ),
    (
        ("knowledge",),
        ("clouds", "_cloud_messages", "_cloud_packets", "_cloud_times"),
        ("faults", "_fault_chance", "_fault_specs", "_fault_traffic"),
    ),
    (
        ("rig", "_rig_values", "_yaml", "_yaml_tree"),
        ("frames",),
        ("urdf",),
        ("ring",),
        ("ledger",),
        ("scan_table",),
        ("turns", "tally"),
        (
            *("doctor", "_doctor_bins", "_doctor_envelope", "_doctor_names", "_doctor_steps"),
            *("clock_compare", "clock_fit"),
        ),
    ),
    (("lidar",), ("transforms",), ("clock",), ("verify",), ("bench",)),
    (("geometry",), ("kernels",), ("pixels",), ("median",)),
    (("types",), ("leap_seconds",)),
    (("rate",), ("units",)),
    (("errors",), ("workers",)),
    # The root: its version. What else it offers, it loads when asked.
    (("",),),
)
PLACE = {
    name: (layer, group)
    for layer, groups in enumerate(LAYERS)
    for group, names in enumerate(groups)
    for name in names
}
MODULES = modules()
NAMES = frozenset(module.name for module in MODULES)


def test_every_module_has_its_place() -> None:
    assert {module.top for module in MODULES} <= set(PLACE)


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.name or "mlbatch")
def test_no_import_to_the_left(module: Module) -> None:
    for found in imports(module, NAMES):
        top = found.target.partition(".")[0]
        if module.name == "":
            assert found.only_for_types, f"{module.path}:{found.line}: the root must load nothing"
            continue
        own, other = PLACE[module.top], PLACE[top]
        assert other == own or other[0] > own[0], (
            f"{module.path}:{found.line}: {module.name} imports {found.target}, "
            "which is not to its right"
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


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.name or "mlbatch")
def test_nobody_names_a_plugin(module: Module) -> None:
    found_by_name = {plugin.name for plugin in plugins()}
    for found in imports(module, NAMES):
        assert found.target not in found_by_name, f"{module.path}:{found.line}: {found.target}"


def test_helpers_of_a_plugin_package_stay_inside() -> None:
    """`_private` modules of a plug-in package are imported by that package alone."""
    for module in MODULES:
        for found in imports(module, NAMES):
            top, _, rest = found.target.partition(".")
            if top in PLUGIN_PACKAGES and rest:
                assert module.top == top, f"{module.path}:{found.line}: {found.target}"
