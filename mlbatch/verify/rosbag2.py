"""ROS 2 bags: metadata.yaml, checked against the MCAP file of the bag.

Source: docs/sources/outputs.md section 4.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TypeAlias

import yaml

from mlbatch.verify.verdict import CheckLog, VerifyError

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


def open_bag(log: CheckLog, folder: Path) -> tuple[Path, Yaml]:
    """The MCAP file of a bag, and the content of metadata.yaml."""
    path = folder / METADATA
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise VerifyError(f"{path}: expected a few lines, found more than 1 MiB; restore it")
        root: Yaml = yaml.load(path.read_text(encoding="utf-8"), PlainLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as err:
        text = " ".join(str(err).split())
        raise VerifyError(f"{path}: expected YAML, found {text}; restore it") from err
    about = _value_at(root, "rosbag2_bagfile_information")
    files = sorted(found for found in folder.iterdir() if found.suffix == ".mcap")
    names = [found.name for found in files]
    said = _value_at(about, "relative_file_paths")
    log.equal("names", f"{METADATA} relative_file_paths", names, said)
    if len(files) != 1:
        raise VerifyError(
            f"{folder}: expected a bag with one MCAP file, found {len(files)}; convert again"
        )
    return files[0], about


def check_metadata(
    log: CheckLog, about: Yaml, name: str, counts: Counter[str], span_ns: tuple[int, int]
) -> None:
    """Check the content of metadata.yaml against the messages of the file `name`."""
    first_ns, last_ns = span_ns
    total = counts.total()
    times: dict[str, Yaml] = {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": total,
    }
    expected: dict[str, Yaml] = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **times,
        "files": [{"path": name, **times}],
    }
    for key, value in expected.items():
        log.equal("metadata", f"{METADATA} {key}", value, _value_at(about, key))
    topics = _value_at(about, "topics_with_message_count")
    said = {}
    for topic in topics if isinstance(topics, list) else []:
        name_of = _value_at(_value_at(topic, "topic_metadata"), "name")
        said[str(name_of)] = _value_at(topic, "message_count")
    log.equal("metadata", f"{METADATA} topics", dict(counts), said)


def _value_at(value: Yaml, key: str) -> Yaml:
    return value.get(key) if isinstance(value, dict) else None
