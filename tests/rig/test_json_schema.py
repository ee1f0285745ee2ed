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

from mlbatch.errors import RigError
from mlbatch.rig.rig import read_rig
from mlbatch.rig.schema import rig_schema
from tests.builders.sessions import REPOSITORY, Shell
from tests.rig.test_convert_keys import SENSORS
from tests.rig.test_mistakes import CASES, VALID
from tests.rig.test_rig import FULL

PAGES = (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md")))
BLOCK = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)


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


# Mistakes that only the reader finds: in YAML, between keys, in values.
BEYOND = (
    *("expected YAML", "control character", "one document", "a word as key", "plain values"),
    *("each key once", "of its own", "not the body frame", "existing file", "more than 5 m"),
    *("0.25 to", "a sensor on a topic", "an IP address", "'.nan'", "'-.inf'", "'1e999'"),
    *("at most 10000 m", "quaternion of norm", "orthonormal", "determinant", "as last row"),
    "y0 < y1",
)
RIG = re.compile(r"printf '%b' '(.*)' > rig.yaml")
REFUSED = [
    rig[1].replace("'\\''", "'").encode().decode("unicode_escape")
    for case in CASES.values()
    if (rig := RIG.fullmatch(case.steps[0].words))
    and "extrinsics: {file" not in rig[1]
    and not any(words in case.steps[1].lines[0] for words in BEYOND)
]
REFUSED += [
    SENSORS + "convert: {jobs: 1.5}\n",
    "sensors: [{name: left, extrinsics: known}]\n",
    "sensors: [{name: left, stream: {port: 0}}]\n",
    "sensors: [{name: left, clock: {offset_s: 5000000000}}]\n",
]


@pytest.mark.parametrize("text", REFUSED)
def test_what_the_reader_refuses_is_not_valid(tmp_path: Path, text: str) -> None:
    assert _errors(text)
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
