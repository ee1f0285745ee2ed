"""`mlbatch batch-status`: the state of a batch as table, JSON and page."""

from __future__ import annotations

import json
import re

import pytest

import mlbatch
from tests.batch.sessions import Dataset, run, write_dataset
from tests.builders.run import command

LINK = re.compile(r"href='([^']+)'")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A batch in the folder `out`: done, cut off, failed, unfinished."""
    names = ["a1", "cut1", "cut2", "hopeless"]
    options = {"cut2": {"fail-on": "cut_off>0"}}
    found = write_dataset(tmp_path_factory.mktemp("status") / "data", names, options)
    out = found.folder / "out"
    assert run(found, out).code == 3
    (out / "later").mkdir()
    (out / "later" / "started.json").write_text("{}", encoding="utf-8")
    (out / "notes").mkdir()
    return found


def test_the_table_has_every_session(data: Dataset) -> None:
    found = command("batch-status", data.folder / "out")
    assert (found.code, found.err) == (0, "")
    lines = found.out.splitlines()
    assert [line.split()[:2] for line in lines[1:-1]] == [
        ["a1", "done"],
        ["cut1", "done"],
        ["cut2", "failed"],
        ["hopeless", "failed"],
        ["later", "unfinished"],
    ]
    assert lines[-1] == "5 sessions: 2 done, 2 failed, 1 unfinished"
    assert lines[2].endswith("  cut_off")
    assert lines[3].endswith("  limit exceeded: cut_off>0: found 1 recordings cut off")


def test_json_has_every_session(data: Dataset) -> None:
    found = json.loads(command("batch-status", data.folder / "out", "--json").out)
    assert found["states"] == {"done": 2, "failed": 2, "unfinished": 1, "known_bad": 0}
    records = {one["name"]: one["record"] for one in found["sessions"]}
    assert records["later"] is None
    assert (records["a1"]["warnings"], records["cut1"]["warnings"]) == ([], ["cut_off"])


def test_the_page_links_to_the_pages_of_runs(data: Dataset) -> None:
    page = data.folder / "status.html"
    assert command("batch-status", data.folder / "out", "--page", page).code == 0
    text = page.read_text(encoding="utf-8")
    links = LINK.findall(text)
    links = [link for link in links if not link.startswith("data:")]
    assert links == [f"out/{name}/page.html" for name in ("cut2", "a1", "cut1")]
    assert all((data.folder / link).exists() for link in links)
    assert "<code>cut_off</code>" in (data.folder / links[0]).read_text(encoding="utf-8")
    assert "2 of 5 sessions failed" in text
    assert "2 with a recording that was cut off." in text
    assert text.count("<strong class='problem'>") == 2
    # Failures first.
    assert text.index("hopeless</td>") < text.index(">a1</a>")
    # No script, and nothing from elsewhere.
    assert "<script" not in text
    assert "http" not in text.replace("http-equiv", "")


def test_a_dataset_has_the_sessions_that_are_done(data: Dataset) -> None:
    found = mlbatch.dataset(data.folder / "out" / "*")
    assert set(found.table["session"]) == {"a1", "cut1"}
    assert {path.name for path in found.skipped} >= {"cut2", "hopeless", "later"}
