"""`mlbatch batch-status`: the state of a batch as table, JSON and page."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.batch.sessions import Dataset, run, write_dataset
from tests.builders.run import command

LINK = re.compile(r"href='([^']+)'")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A batch in the folder `out`: done, lossy, failed, unfinished."""
    folder = tmp_path_factory.mktemp("status")
    found = write_dataset(folder / "data", ["a1", "a2", "hopeless"])
    out = folder / "data" / "out"
    assert run(found, out, "--only", "a1", "--only", "hopeless").code == 3
    assert run(found, out, "--only", "a2", "--fault", "drop:ouster_111:20%").code == 0
    (out / "later").mkdir()
    (out / "later" / "started.json").write_text("{}", encoding="utf-8")
    (out / "notes").mkdir()
    return found


def test_the_table_has_every_session(data: Dataset) -> None:
    found = command("batch-status", data.folder / "out")
    assert (found.code, found.err) == (0, "")
    rows = {line.split()[0]: line.split()[1] for line in found.out.splitlines()[1:-1]}
    assert rows == {"a1": "done", "a2": "done", "hopeless": "failed", "later": "unfinished"}
    assert found.out.splitlines()[-1] == "4 sessions: 2 done, 1 failed, 1 unfinished"


def test_a_recording_that_was_cut_off_is_shown(tmp_path: Path) -> None:
    """In table, JSON and page of the batch, on the page of the run; by --fail-on it fails."""
    found = write_dataset(tmp_path / "data", ["a1", "a2"])
    capture = found.folder / "raw" / "a1" / "drive.pcap"
    # Within the last record: all packets before it are there, and none counts as lost.
    capture.write_bytes(capture.read_bytes()[:-100])
    out = found.folder / "out"
    assert run(found, out).code == 0
    lines = command("batch-status", out).out.splitlines()
    table = {line.split()[0]: line.split() for line in lines}
    assert (table["a1"][1], table["a1"][3]) == ("done", "0.00")
    assert (table["a1"][-1], "cut_off" in table["a2"]) == ("cut_off", False)
    records = json.loads(command("batch-status", out, "--json").out)["sessions"]
    assert [one["record"]["warnings"] for one in records] == [["cut_off"], []]
    assert command("batch-status", out, "--page", tmp_path / "status.html").code == 0
    page = (tmp_path / "status.html").read_text(encoding="utf-8")
    assert "1 with a recording that was cut off." in page
    assert page.count("<strong class='problem'>cut_off</strong>") == 1
    assert "<code>cut_off</code>" in (out / "a1" / "page.html").read_text(encoding="utf-8")
    strict = found.folder / "strict"
    assert run(found, strict, "--fail-on", "cut_off>0").table == {"a1": "failed", "a2": "done"}
    line = "limit exceeded: cut_off>0: found 1 recordings cut off"
    assert line in command("batch-status", strict).out


def test_json_has_the_figures_of_the_reports(data: Dataset) -> None:
    out = data.folder / "out"
    found = json.loads(command("batch-status", out, "--json").out)
    assert found["schema"] == "mlbatch.status/1"
    assert found["states"] == {"done": 2, "failed": 1, "unfinished": 1}
    by_name = {one["name"]: one for one in found["sessions"]}
    assert by_name["later"]["record"] is None
    record = by_name["a2"]["record"]
    report = json.loads((out / "a2" / "report.json").read_text(encoding="utf-8"))
    (sensor,) = report["sensors"]
    assert record["lost"] == sensor["packets"]["lost"] > 0
    assert record["packets"] == sensor["packets"]["read"]
    assert record["scans"] == report["scans"]["written"]
    assert record["fill"] == sensor["fill"]
    assert "loss" in record["warnings"]
    files = [out / "a2" / "scans.mcap", out / "a2" / "scans.mcap.scans.csv"]
    assert record["output_bytes"] == sum(path.stat().st_size for path in files)


def test_the_page_links_to_the_pages_of_runs(data: Dataset) -> None:
    page = data.folder / "status.html"
    assert command("batch-status", data.folder / "out", "--page", page).code == 0
    text = page.read_text(encoding="utf-8")
    links = LINK.findall(text)
    assert [link for link in links if not link.startswith("data:")] == [
        "out/a1/page.html",
        "out/a2/page.html",
    ]
    assert all((data.folder / link).exists() for link in ("out/a1/page.html", "out/a2/page.html"))
    assert "1 of 4 sessions failed" in text
    # Failures first.
    assert text.index("hopeless</td>") < text.index(">a1</a>")
    # No script, and nothing from elsewhere.
    assert "<script" not in text
    assert "http" not in text.replace("http-equiv", "")


def test_names_and_lines_are_text(data: Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "out" / "<b>x"
    folder.mkdir(parents=True)
    record = {"schema": "mlbatch.session/1", "name": "x", "state": "failed", "exit_code": 1}
    record |= {"line": "<script>alert(1)</script>", "key": {}}
    (folder / "session.json").write_text(json.dumps(record), encoding="utf-8")
    page = tmp_path / "status.html"
    assert command("batch-status", tmp_path / "out", "--page", page).code == 0
    assert "<script" not in page.read_text(encoding="utf-8")
    assert "&lt;b&gt;x" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": "mlbatch.session/1"}', "null", "7"])
def test_a_damaged_record_is_an_unfinished_session(text: str, tmp_path: Path) -> None:
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "session.json").write_text(text, encoding="utf-8")
    found = command("batch-status", tmp_path / "out")
    assert (found.code, found.out.splitlines()[-1]) == (
        *(0, "1 sessions: 0 done, 0 failed, 1 unfinished"),
    )


def test_no_batch_is_one_line(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing"):
        found = command("batch-status", path)
        assert (found.code, found.out) == (1, "")
        assert len(found.err.splitlines()) == 1


def test_another_file_is_not_replaced_by_a_page(data: Dataset, tmp_path: Path) -> None:
    page = tmp_path / "thesis.html"
    page.write_text("mine", encoding="utf-8")
    assert command("batch-status", data.folder / "out", "--page", page).code == 1
    assert page.read_text(encoding="utf-8") == "mine"
