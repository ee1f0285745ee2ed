"""Recipes: rigs of public datasets, with their facts and the page of each.

A recipe is a rig in `mlbatch/datasets` with the key `dataset`. Files that it names are those of the
dataset, around the recordings.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mlbatch.errors import UsageError
from mlbatch.rig.keys import Key
from mlbatch.rig.rig import DATASET, STAMP
from mlbatch.rig.yaml_tree import Node, read_yaml

FOLDER = Path(__file__).parents[1] / "datasets"
MARKS = ("verified on real files", "by published facts", "disputed")
CONTENTS = ("raw", "decoded", "raw and decoded")
FACTS = ("lidars", "size", "licence", "topics", "times", "poses")
UNKNOWN = "not verified"

_TEXT = re.compile(r"\S(.*\S)?")
_PAGE = re.compile(r"https?://\S+")
# Folders, with those above a recording, in which a dataset may have its calibration.
LEVELS = 3
_FILE_KEYS = ("file", "metadata")


class Dataset(NamedTuple):
    """Facts about a public dataset.

    recording: what is given to `mlbatch convert`; pages: URLs by fact, none: not verified;
    not_verified: what no page says; refused: why it cannot be batched, or ""; signs: further topics
    or files by which it is recognised.
    """

    title: str
    mark: str
    lidars: str
    data: str
    size: str
    licence: str
    recording: str
    pages: Mapping[str, tuple[str, ...]]
    not_verified: tuple[str, ...] = ()
    remarks: str = ""
    refused: str = ""
    signs: tuple[str, ...] = ()

    @property
    def caution(self) -> str:
        """How the recipe was checked, and what no page says."""
        return "; not verified: ".join([self.mark, *filter(None, [", ".join(self.not_verified)])])


# Facts in words: those without a page are not verified.
_IN_WORDS = ("lidars", "size", "licence")
_REQUIRED = tuple(
    name for name in Dataset._fields if name not in (*Dataset._field_defaults, *_IN_WORDS)
)
_LISTS = ("not_verified", "signs")


def dataset_of(node: Node) -> Dataset:
    """The facts of a recipe; RigError for the first mistake."""
    fields = node.fields(Dataset._fields, _REQUIRED)
    fields["mark"].choice(MARKS)
    fields["data"].choice(CONTENTS)
    pages = fields["pages"].fields(FACTS, FACTS)
    lists = {
        name: tuple(map(_text, fields[name].elements("texts"))) for name in _LISTS if name in fields
    }
    others = {name: _text(fields[name]) for name in fields if name not in (*_LISTS, "pages")}
    urls = {fact: _urls(value) for fact, value in pages.items()}
    for fact in _IN_WORDS:
        if (fact in fields) != bool(urls[fact]):
            has = "its page in pages" if fact in fields else f"the fact of its page, {fact}"
            raise fields.get(fact, node).error(has, UNKNOWN, "give both, or leave both out")
    return Dataset(**{**dict.fromkeys(_IN_WORDS, UNKNOWN), **others, **lists, "pages": urls})  # type: ignore[arg-type]


def _text(node: Node) -> str:
    return node.word("a text", _TEXT)


def _urls(node: Node) -> tuple[str, ...]:
    if node.kind == "scalar" and node.text == UNKNOWN:
        return ()
    items = node.items if node.kind == "list" else (node,)
    return tuple(item.word(f"the URL of a page, or {UNKNOWN}", _PAGE) for item in items)


DATASET_KEY = Key(
    DATASET,
    dataset_of,
    {"type": "object", "required": list(_REQUIRED)},
    "facts about a public dataset; files are searched around the recordings",
)


def recipe_names() -> list[str]:
    """Names for `--dataset`."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def recipe_path(name: str, option: str = "--dataset") -> Path:
    """The rig of a dataset; UsageError names the nearest ones."""
    known = recipe_names()
    if name not in known:
        plain = {re.sub(r"\W|_", "", one): one for one in known}
        text = re.sub(r"\W|_", "", name.lower())
        near = [plain[one] for one in difflib.get_close_matches(text, plain, 3, 0.5)]
        remedy = f"the nearest are {', '.join(near)}" if near else "see `mlbatch datasets`"
        raise UsageError(f"{option}: expected the name of a dataset, found {name!r}; {remedy}")
    return FOLDER / f"{name}.yaml"


def recipe(name: str) -> Dataset:
    """The facts of a dataset."""
    return dataset_of(read_yaml(recipe_path(name)).entry(DATASET))


def rig_of(rig: Path | None, dataset: str | None, option: str = "--dataset") -> Path | None:
    """The file of the rig that is given, or of the recipe; UsageError for both."""
    if dataset is None:
        return rig
    path = recipe_path(dataset, option)
    if rig is not None:
        raise UsageError(
            f"{option}: expected a dataset or a rig, found both; to change a recipe: `mlbatch "
            f"datasets {dataset} > my.yaml`, edit it, and give --rig my.yaml alone"
        )
    facts = recipe(dataset)
    if facts.refused:
        raise UsageError(
            f"{option}: expected a dataset that can be batched, found {facts.title}: "
            f"{facts.refused}; choose another (mlbatch datasets)"
        )
    return path


# -- its files ------------------------------------------------------------------------------------


def with_files(root: Node, recordings: Sequence[Path]) -> Node:
    """The tree of a recipe with paths of the files that it names; RigError where one lacks."""
    dataset = dataset_of(root.entries[DATASET])
    folders = [] if root.file.parent == FOLDER else [root.file.parent]
    for recording in recordings or (Path(),):
        folder = (recording if recording.is_dir() else recording.parent).absolute()
        folders += [folder, *folder.parents[: LEVELS - 1]]
    return _with_files(root, "", tuple(dict.fromkeys(folders)), dataset)


def named_files(rig: Path) -> list[Node]:
    """Files that a recipe names and that are not next to it; none of another rig."""
    root = read_yaml(rig)
    if DATASET not in root.entries:
        return []
    named = {node.text: node for node in _named(root, "")}
    return [node for node in named.values() if next(rig.parent.glob(node.text), None) is None]


def _named(node: Node, key: str) -> Iterator[Node]:
    if key in _FILE_KEYS and node.kind == "scalar":
        yield node
    for name, one in node.entries.items():
        yield from _named(one, name)
    for one in node.items:
        yield from _named(one, key)


def _with_files(node: Node, key: str, folders: Sequence[Path], dataset: Dataset) -> Node:
    if key in _FILE_KEYS and node.kind == "scalar":
        return node._replace(text=str(_found(node, folders, dataset)))
    entries = {name: _with_files(one, name, folders, dataset) for name, one in node.entries.items()}
    items = tuple(_with_files(one, key, folders, dataset) for one in node.items)
    return node._replace(entries=entries, items=items)


def _found(node: Node, folders: Sequence[Path], dataset: Dataset) -> Path:
    for folder in folders:
        if (folder / node.text).is_file():
            return folder / node.text
        matches = sorted(folder.glob(node.text)) if "*" in node.text else []
        if len(matches) > 1:
            shown = ", ".join(path.name for path in matches)
            raise node.error(f"one {node.text} in {folder}", shown, "keep that of the recordings")
        if matches:
            return matches[0]
    page = next(iter(dataset.pages["poses"]), "its page")
    where = f"{node.text} of {dataset.title} in {folders[0]} or a folder above"
    raise node.error(where, "none", f"copy it there ({page})")


# -- recognition ----------------------------------------------------------------------------------


def by_topics(topics: Collection[str]) -> list[str]:
    """Datasets all of whose topics are there, those with the most of them first."""
    texts = [f"topic: {topic}}}" for topic in topics]
    # One topic alone is that of many recordings.
    return _with_most(("stream", "topic"), 2, texts, lambda topic: topic in topics)


def by_files(folder: Path) -> list[str]:
    """Datasets whose files of sweeps are in a folder, those with the most lidars first."""
    return _with_most(
        ("points", "glob"), 1, [""], lambda glob: any(folder.glob(STAMP.sub("*", glob)))
    )


def _with_most(
    keys: tuple[str, str], least: int, texts: Sequence[str], is_there: Callable[[str], bool]
) -> list[str]:
    """Recipes whose sensors' key and all signs are there; a recipe must have one of the texts."""
    section, key = keys
    found = []
    for name in recipe_names():
        text = recipe_path(name).read_text(encoding="utf-8")
        # Parsing all of them takes longer than reading a short recording.
        if not any(one in text for one in texts):
            continue
        root = read_yaml(recipe_path(name))
        words = set(dataset_of(root.entries[DATASET]).signs)
        for sensor in root.entries["sensors"].items if "sensors" in root.entries else ():
            node = sensor.entries.get(section)
            if node is None or key not in node.entries:
                break
            words.add(node.entries[key].text.replace("{sensor}", sensor.entries["name"].text))
        else:
            if len(words) >= least and all(map(is_there, words)):
                found.append((-len(words), name))
    return [name for _, name in sorted(found)]


def proposal(found: Sequence[str]) -> str:
    """A line about datasets that a recording may be of; "" without any."""
    if not found:
        return ""
    first = recipe(found[0])
    use = f"give --dataset {', or '.join(found)}; its recipe: {first.mark}"
    if first.refused:
        use = f"it cannot be batched: {first.refused}"
    return f"topics or files are those of {first.title}: {use}"
