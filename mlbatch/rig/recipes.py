"""Recipes: rigs of public datasets, with their facts and the page of each.

A recipe is a rig in `mlbatch/datasets` with the key `dataset`. Files that it names are those of the
dataset, around the recordings.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mlbatch.errors import UsageError
from mlbatch.rig.keys import TEXT, Key, choice_form, mapping_form, names
from mlbatch.rig.rig import DATASET
from mlbatch.rig.yaml_tree import Node, read_yaml

FOLDER = Path(__file__).parents[1] / "datasets"
MARKS = ("verified on real files", "by published facts", "disputed")
CONTENTS = ("raw", "decoded", "raw and decoded")
FACTS = ("lidars", "size", "licence", "topics", "times", "poses")
UNKNOWN = "not verified"

_TEXT = re.compile(r"\S(.*\S)?")
_PAGE = re.compile(r"https?://\S+")
# Folders above a recording in which a dataset may have its calibration.
_LEVELS = 3
_NAMED_PART = re.compile(r"\{stamp[^}]*\}")


class Dataset(NamedTuple):
    """Facts about a public dataset.

    recording: what is given to `mlbatch convert`; signs: further topics or files of its
    recordings; pages: URLs by fact, none: not verified; refused: why it cannot be batched, or "".
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


def _text(node: Node) -> str:
    return node.word("a text", _TEXT)


def _texts(node: Node) -> tuple[str, ...]:
    return tuple(map(_text, node.elements("texts")))


def _pages(node: Node) -> Mapping[str, tuple[str, ...]]:
    return {fact: _urls(value) for fact, value in node.fields(FACTS, FACTS).items()}


def _urls(node: Node) -> tuple[str, ...]:
    if node.kind == "scalar" and node.text == UNKNOWN:
        return ()
    items = node.items if node.kind == "list" else (node,)
    return tuple(item.word(f"the URL of a page, or {UNKNOWN}", _PAGE) for item in items)


def _key(name: str, about: str) -> Key[str]:
    return Key(name, _text, "", TEXT, about)


def _choice_key(name: str, words: Sequence[str], about: str) -> Key[str]:
    return Key(name, lambda node: node.choice(words), "", choice_form(*words), about)


def _texts_key(name: str, about: str) -> Key[tuple[str, ...]]:
    return Key(name, _texts, (), {"type": "array", "items": TEXT}, about)


_PAGES: Key[Mapping[str, tuple[str, ...]]] = Key(
    "pages",
    _pages,
    {},
    {"type": "object", "propertyNames": {"enum": list(FACTS)}},
    f"URL or URLs of each fact, or {UNKNOWN}",
)
_KEYS = (
    _key("title", "its name"),
    _choice_key("mark", MARKS, "how the recipe was checked"),
    _key("lidars", "number and models"),
    _choice_key("data", CONTENTS, "what is recorded"),
    _key("size", "of all recordings"),
    _key("licence", "of the dataset"),
    _key("recording", "what is given to `mlbatch convert`"),
    _PAGES,
    _texts_key("not_verified", "what no page says"),
    _key("remarks", "limits"),
    _key("refused", "why it cannot be batched"),
    _texts_key("signs", "further topics or files by which it is recognised"),
)
_REQUIRED = ("title", "mark", "lidars", "data", "size", "licence", "recording", "pages")


def dataset_of(node: Node) -> Dataset:
    """The facts of a recipe; RigError for the first mistake."""
    fields = node.fields(names(_KEYS), _REQUIRED)
    return Dataset(**{key.name: key.of(fields) for key in _KEYS})  # type: ignore[arg-type]


DATASET_KEY: Key[Dataset | None] = Key(
    DATASET,
    dataset_of,
    None,
    mapping_form(_KEYS, required=_REQUIRED),
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
        near += [
            one for key, one in plain.items() if len(text) > 2 and text in key and one not in near
        ]
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
        folders += [folder, *folder.parents[: _LEVELS - 1]]
    return _with_files(root, "", tuple(dict.fromkeys(folders)), dataset)


def _with_files(node: Node, key: str, folders: Sequence[Path], dataset: Dataset) -> Node:
    if key in ("file", "metadata") and node.kind == "scalar":
        return node._replace(text=str(_found(node, folders, dataset)))
    entries = {name: _with_files(one, name, folders, dataset) for name, one in node.entries.items()}
    items = tuple(_with_files(one, key, folders, dataset) for one in node.items)
    return node._replace(entries=entries, items=items)


def _found(node: Node, folders: Sequence[Path], dataset: Dataset) -> Path:
    for folder in folders:
        matches = sorted(folder.glob(node.text))
        if len(matches) > 1:
            shown = ", ".join(path.name for path in matches)
            raise node.error(f"one {node.text} in {folder}", shown, "keep that of the recordings")
        if matches:
            return matches[0]
    page = next(iter(dataset.pages["poses"]), "its page")
    raise node.error(
        f"{node.text} of {dataset.title} in {folders[0]} or a folder above",
        "none",
        f"copy it there ({page})",
    )


# -- recognition ----------------------------------------------------------------------------------


def by_topics(topics: Collection[str]) -> list[str]:
    """Datasets all of whose topics are there, those with the most of them first."""
    found = []
    for name, root in _roots():
        lidars = {_part(sensor, "stream", "topic") for sensor in _sensors(root)} - {""}
        needed = lidars | set(dataset_of(root.entries[DATASET]).signs)
        # One topic alone is that of many recordings.
        if lidars and len(needed) > 1 and needed <= set(topics):
            found.append((-len(needed), name))
    return [name for _, name in sorted(found)]


def by_files(folder: Path) -> list[str]:
    """Datasets whose files of sweeps are in a folder, those with the most lidars first."""
    found = []
    for name, root in _roots():
        globs = [
            _NAMED_PART.sub("*", glob.replace("{sensor}", sensor.entries["name"].text))
            for sensor in _sensors(root)
            if (glob := _part(sensor, "points", "glob"))
        ]
        signs = dataset_of(root.entries[DATASET]).signs
        if globs and all(any(folder.glob(glob)) for glob in (*globs, *signs)):
            found.append((-len(globs), name))
    return [name for _, name in sorted(found)]


def _roots() -> Iterator[tuple[str, Node]]:
    for name in recipe_names():
        yield name, read_yaml(FOLDER / f"{name}.yaml")


def _sensors(root: Node) -> Sequence[Node]:
    return root.entries["sensors"].items if "sensors" in root.entries else ()


def _part(sensor: Node, section: str, key: str) -> str:
    """Text of a key of a section of a sensor; "" without one."""
    node = sensor.entries.get(section)
    return "" if node is None or key not in node.entries else node.entries[key].text


def proposal(found: Sequence[str]) -> str:
    """A line about datasets that a recording may be of; "" without any."""
    if not found:
        return ""
    first = recipe(found[0])
    if first.refused:
        return (
            f"topics or files are those of {first.title}, which cannot be batched: {first.refused}"
        )
    others = f" (or {', '.join(found[1:])})" if len(found) > 1 else ""
    use = f"give --dataset {found[0]}{others}"
    return f"topics or files are those of {first.title}: {use}; its recipe: {first.mark}"
