"""`mlbatch schema rig`: a JSON schema that all rigs of fixtures and pages validate against."""

from __future__ import annotations

import json
import re
import textwrap
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from mlbatch.rig.rig import read_rig
from mlbatch.rig.schema import rig_schema
from tests.builders.sessions import REPOSITORY, Shell
from tests.rig.test_mistakes import VALID
from tests.rig.test_rig import FULL

PAGES = (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md")))
BLOCK = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
ONE = "sensors: [{name: a, %s}]"


class Loader(yaml.SafeLoader):
    """Numbers as in YAML 1.2, which editors use: 1e-1 is one."""


Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.\d+|\d+(\.\d*)?)([eE][-+]?\d+)?$"),
    "-+.0123456789",
)


def _errors(text: str) -> list[str]:
    validator = jsonschema.Draft202012Validator(rig_schema())
    values = yaml.load(text, Loader)
    return [f"{one.json_path}: {one.message}" for one in validator.iter_errors(values)]


def _is_valid(text: str) -> bool:
    return not _errors(text)


def _blocks() -> list[str]:
    """Rigs in README and docs."""
    texts = [
        textwrap.dedent(text)
        for page in PAGES
        for language, text in BLOCK.findall(page.read_text(encoding="utf-8"))
        if language in ("", "yaml")
    ]
    return [
        text
        for text in texts
        if re.search(r"^sensors:", text, re.MULTILINE) and "schema: mlbatch.scenario" not in text
    ]


def test_the_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(rig_schema())


def test_the_command_prints_it(shell: Shell) -> None:
    outcome = shell("schema rig")
    assert (outcome.code, outcome.err) == (0, "")
    assert json.loads(outcome.out) == rig_schema()
    wrong = shell("schema report")
    assert (wrong.code, wrong.out) == (2, "")
    assert wrong.err == ("mlbatch: error: schema: expected rig, found 'report'; write schema rig\n")


@pytest.mark.parametrize("path", sorted((REPOSITORY / "fixtures").rglob("rig*.yaml")), ids=str)
def test_rigs_of_fixtures_are_valid(path: Path) -> None:
    assert _errors(path.read_text(encoding="utf-8")) == []


def test_rigs_of_pages_are_valid() -> None:
    blocks = _blocks()
    assert len(blocks) >= 2
    for block in blocks:
        assert _errors(block) == [], block


@pytest.mark.parametrize("text", [FULL, VALID], ids=["full", "valid"])
def test_rigs_of_tests_are_valid(text: str) -> None:
    assert _errors(text) == []


@pytest.mark.parametrize("name", ["two_lidars/two_lidars.pcap", "four_makers/four_makers.pcap"])
def test_written_rigs_are_valid(shell: Shell, name: str) -> None:
    outcome = shell("inspect", REPOSITORY / "fixtures" / name, "--write-rig", "-")
    assert outcome.code == 0
    assert _errors(outcome.out) == []


# Refused by the reader and by the schema: what is wrong, in a word.
WRONG = (
    "rate_hz: 10",
    "sensors: []",
    "[1]",
    "sensors: [{name: a}]\nrate: 10",
    "sensors: [{name: a}]\nrate_hz: fast",
    "sensors: [{name: a}]\nbody_frame: a b",
    "sensors: [{name: a}]\nexclude_boxes_m: [[0, 0, 0, 1, 1]]",
    "sensors: [{name: a}]\nconvert: {job: 4}",
    "sensors: [{name: a}]\nconvert: {jobs: 0}",
    "sensors: [{name: a}]\nconvert: {jobs: 1.5}",
    "sensors: [{name: a}]\nconvert: {split: 1}",
    "sensors: [{name: a}]\nconvert: {layout: flat}",
    "sensors: [{name: a}]\nconvert: {drop_incomplete: 101}",
    "sensors: [{name: a}]\nconvert: {only: {a: b}}",
    "sensors: [{model: auto}]",
    "sensors: [{name: 1a}]",
    ONE % "stream: {}",
    ONE % "stream: {ip: 10.0.0.1}",
    ONE % "stream: {port: 0}",
    ONE % "stream: {port: 70000}",
    ONE % "stream: {topic: /a, port: 7502}",
    ONE % "stream: {frame_id: os_left}",
    ONE % "extrinsics: known",
    ONE % "extrinsics: {}",
    ONE % "extrinsics: {translation_m: [1, 2]}",
    ONE % "extrinsics: {rotation_rpy_deg: [0, 0, 0], rotation_xyzw: [0, 0, 0, 1]}",
    ONE % "extrinsics: {matrix: [[1, 0, 0, 0]]}",
    ONE % "extrinsics: {frame: os_left, translation_m: [1, 2, 3]}",
    ONE % "clock: {source: gps}",
    ONE % "clock: {offset_s: 5000000000}",
    ONE % "min_range_m: -1",
    ONE % "min_range_m: near",
    ONE % "optional: maybe",
    ONE % "points: {unit: m}",
    ONE % "decode: [crc]",
)


@pytest.mark.parametrize("text", WRONG)
def test_wrong_rigs_are_neither_valid_nor_read(tmp_path: Path, text: str) -> None:
    from mlbatch.errors import RigError

    assert not _is_valid(text)
    file = tmp_path / "rig.yaml"
    file.write_text(text)
    with pytest.raises(RigError):
        read_rig(file)


def test_every_key_is_described() -> None:
    def properties(form: Any) -> list[Any]:
        if isinstance(form, list):
            return [one for part in form for one in properties(part)]
        if not isinstance(form, dict):
            return []
        own = list(form.get("properties", {}).values())
        return own + [one for value in form.values() for one in properties(value)]

    found = properties(rig_schema())
    assert len(found) > 50
    assert all(one["description"] for one in found)
