"""metadata.yaml of a ROS 2 bag against the file that it describes (facts/outputs.md, section 4)."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TypeAlias, cast

from mlbatch.verify.verdict import Judge, VerifyError

METADATA = "metadata.yaml"
_VERSION = 5
_LARGEST_BYTES = 1 << 22
Yaml: TypeAlias = "dict[str, Yaml] | list[Yaml] | str | int | float | bool | None"


def bag_file(judge: Judge, folder: Path) -> tuple[Path, Yaml]:
    """The MCAP file of a bag, and what metadata.yaml says."""
    # Only bags need it.
    import yaml

    path = folder / METADATA
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise VerifyError(f"{path}: wanted a few lines, got more than 4 MiB")
        root: Yaml = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as err:
        text = " ".join(str(err).split())
        raise VerifyError(f"{path}: wanted YAML, got {text}; restore it") from err
    about = _at(root, "rosbag2_bagfile_information")
    files = sorted(found for found in folder.iterdir() if found.suffix == ".mcap")
    names = [found.name for found in files]
    judge.equal(
        "names", f"{METADATA} relative_file_paths", names, _at(about, "relative_file_paths")
    )
    if len(files) != 1:
        raise VerifyError(f"{folder}: wanted a bag with one MCAP file, got {len(files)}")
    return files[0], about


def check_metadata(
    judge: Judge, about: Yaml, name: str, counts: Counter[str], span_ns: tuple[int, int]
) -> None:
    """What metadata.yaml says against what was read."""
    first_ns, last_ns = span_ns
    duration = {"nanoseconds": last_ns - first_ns}
    start = {"nanoseconds_since_epoch": first_ns}
    total = counts.total()
    wanted: dict[str, Yaml] = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        "duration": cast(Yaml, duration),
        "starting_time": cast(Yaml, start),
        "message_count": total,
        "files": [
            {
                "path": name,
                "starting_time": cast(Yaml, start),
                "duration": cast(Yaml, duration),
                "message_count": total,
            }
        ],
    }
    for key, value in wanted.items():
        judge.equal("metadata", f"{METADATA} {key}", value, _at(about, key))
    topics = _at(about, "topics_with_message_count")
    said = {}
    for topic in topics if isinstance(topics, list) else []:
        name_of = _at(_at(topic, "topic_metadata"), "name")
        said[str(name_of)] = _at(topic, "message_count")
    judge.equal("metadata", f"{METADATA} topics", dict(counts), said)


def _at(value: Yaml, key: str) -> Yaml:
    return value.get(key) if isinstance(value, dict) else None
