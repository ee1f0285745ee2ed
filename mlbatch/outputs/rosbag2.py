"""ROS 2 bags: metadata.yaml, checked against the MCAP files of the bag.

Source: docs/sources/outputs.md section 4.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import yaml

from mlbatch.bounded import read_text
from mlbatch.outputs.damage import CheckLog, VerifyError

METADATA = "metadata.yaml"
_VERSION = 5
_LARGEST_BYTES = 1 << 20
Yaml: TypeAlias = "dict[str, Yaml] | list[Yaml] | str | int | float | bool | None"


class PlainLoader(yaml.SafeLoader):
    """Refuses aliases: a few of them can expand to gigabytes."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose all nodes but aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


class BagFile(NamedTuple):
    """What was found in one MCAP file: messages, first and last log time."""

    name: str
    messages: int
    span_ns: tuple[int, int]


def read_metadata(folder: Path) -> Yaml:
    """The content of metadata.yaml."""
    path = folder / METADATA
    try:
        root: Yaml = yaml.load(read_text(path, _LARGEST_BYTES), PlainLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as err:
        text = " ".join(str(err).split())
        raise VerifyError(f"{path}: expected YAML, found {text}; restore it") from err
    return _value_at(root, "rosbag2_bagfile_information")


def listed_files(folder: Path) -> list[str]:
    """The names of the files of a bag in its metadata.yaml."""
    names = _value_at(read_metadata(folder), "relative_file_paths")
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
    said = _value_at(about, "relative_file_paths")
    log.equal("names", f"{METADATA} relative_file_paths", names, said)
    if not files:
        raise VerifyError(f"{folder}: expected a bag with MCAP files, found none; convert again")
    return files, about


def check_metadata(
    log: CheckLog, about: Yaml, files: Sequence[BagFile], counts: Counter[str]
) -> None:
    """Check the content of metadata.yaml against files; counts: of their messages by topic."""
    first_ns = min(file.span_ns[0] for file in files)
    last_ns = max(file.span_ns[1] for file in files)
    expected: dict[str, Yaml] = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **_times((first_ns, last_ns), counts.total()),
        "files": [{"path": file.name, **_times(file.span_ns, file.messages)} for file in files],
    }
    for key, value in expected.items():
        log.equal("metadata", f"{METADATA} {key}", value, _value_at(about, key))
    topics = _value_at(about, "topics_with_message_count")
    said = {}
    for topic in topics if isinstance(topics, list) else []:
        name_of = _value_at(_value_at(topic, "topic_metadata"), "name")
        said[str(name_of)] = _value_at(topic, "message_count")
    log.equal("metadata", f"{METADATA} topics", dict(counts), said)


def _times(span_ns: tuple[int, int], messages: int) -> dict[str, Yaml]:
    first_ns, last_ns = span_ns
    return {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": messages,
    }


def _value_at(value: Yaml, key: str) -> Yaml:
    return value.get(key) if isinstance(value, dict) else None
