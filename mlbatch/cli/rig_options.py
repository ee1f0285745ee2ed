"""Options of `mlbatch convert` that the rig file keeps; the command line overrides them.

Those that another command does not have are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mlbatch.errors import MlbatchError, RigError, UsageError

_SECTION = b"convert"


def take(context: Any, params: Sequence[Any]) -> Mapping[str, str]:
    """Set options from the rig unless the command line gives them; return their places by name."""
    given = context.params.get("rig")
    rig = Path(given or "")
    if given is None or not _may_have_section(rig):
        return {}
    from mlbatch.rig.rig import read_rig

    by_key = {str(param.name).rstrip("_"): param for param in params}
    places = {}
    for option in read_rig(rig, tuple(context.params.get("recordings") or ())).options:
        param = by_key.get(option.name)
        if param is None:
            continue
        if context.get_parameter_source(param.name).name != "DEFAULT":
            continue
        value = list(option.values) if param.multiple else option.values[0]
        context.params[param.name] = param.type_cast_value(context, value)
        places[f"--{option.name.replace('_', '-')}"] = option.place
    return places


def located(err: UsageError, places: Mapping[str, str]) -> MlbatchError:
    """An error about an option; with its place if that is in the rig."""
    words = str(err).replace(":", " ").split(maxsplit=1)
    place = places.get(words[0]) if words else None
    return err if place is None else RigError(f"{place}: {err}")


def _may_have_section(rig: Path) -> bool:
    """False if a rig has no such section for certain; most need not be read twice."""
    from mlbatch.bounded import read_bytes
    from mlbatch.rig.yaml_tree import MAX_BYTES

    try:
        return _SECTION in read_bytes(rig, MAX_BYTES)
    except OSError:
        # Reported where the rig is read.
        return False
