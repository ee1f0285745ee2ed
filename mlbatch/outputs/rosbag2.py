"""ROS 2 bags: metadata.yaml and the MCAP files of the bag.

Source: docs/sources/outputs.md section 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import yaml

from mlbatch.bounded import read_text
from mlbatch.outputs.damage import CheckLog, VerifyError

METADATA = "metadata.yaml"
_LARGEST_BYTES = 1 << 20
Yaml: TypeAlias = "dict[str, Yaml] | list[Yaml] | str | int | float | bool | None"


class PlainLoader(yaml.SafeLoader):
    """Refuses aliases: a few of them can expand to gigabytes."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose all nodes but aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


def read_metadata(folder: Path) -> Yaml:
    """The content of metadata.yaml."""
    path = folder / METADATA
    try:
        root: Yaml = yaml.load(read_text(path, _LARGEST_BYTES), PlainLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as err:
        text = " ".join(str(err).split())
        raise VerifyError(f"{path}: expected YAML, found {text}; restore it") from err
    return value_at(root, "rosbag2_bagfile_information")


def listed_files(folder: Path) -> list[str]:
    """The names of the files of a bag in its metadata.yaml."""
    names = value_at(read_metadata(folder), "relative_file_paths")
    return [str(name) for name in names] if isinstance(names, list) else []


def open_bag(log: CheckLog, folder: Path) -> tuple[list[Path], Yaml]:
    """The MCAP files of a bag by their numbers, one at least, and the content of metadata.yaml."""
    about = read_metadata(folder)
    files = sorted(
        (found for found in folder.iterdir() if found.suffix == ".mcap"),
        # Numbers have no leading zeros.
        key=lambda found: (len(found.name), found.name),
    )
    names = [found.name for found in files]
    said = value_at(about, "relative_file_paths")
    log.equal("names", f"{METADATA} relative_file_paths", names, said)
    if not files:
        raise VerifyError(f"{folder}: expected a bag with MCAP files, found none; convert again")
    return files, about


def value_at(value: Yaml, key: str) -> Yaml:
    """The value of a key; None if there is none."""
    return value.get(key) if isinstance(value, dict) else None
