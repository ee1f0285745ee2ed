"""Conversions from and to object storage; what a batch there does besides is in test_outcomes."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.batch import remote
from mlbatch.errors import Interrupted, RecordingError
from mlbatch.rig.recipes import FOLDER
from tests.batch.network import Cloud, cloud_of
from tests.batch.sessions import write_dataset
from tests.builders import datasets as made
from tests.builders.run import command


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cloud]:
    with cloud_of(write_dataset(tmp_path_factory.mktemp("cloud") / "data", ["a1"])) as found:
        yield found


def near(cloud: Cloud, output: Path, *words: str | Path) -> Path:
    """The local recording, converted."""
    capture = cloud.data.folder / "raw" / "a1" / "drive.pcap"
    ended = cloud.run("convert", capture, "-o", output, "--rate", "20", "--quiet", *words)
    assert ended.code == 0, ended.err
    return output


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for copies."""
    monkeypatch.setenv("MLBATCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_another_version_is_a_changed_input(cloud: Cloud, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(cloud.data.folder / "raw" / "a1", tmp_path / "new"))
    words = ("batch", "s3://data/new/a1/*.pcap", "-o", tmp_path / "out")
    for path in folder.iterdir():
        cloud.put(f"new/a1/{path.name}", path)
    assert cloud.run(*words).table == {"drive": "done"}
    assert cloud.run(*words, "--plan").table == {"drive": "done"}
    assert cloud.run(*words).table == {"drive": "skipped"}
    capture = folder / "drive.pcap"
    capture.write_bytes(capture.read_bytes()[:-3000])
    cloud.put("new/a1/drive.pcap", capture)
    assert cloud.run(*words, "--plan").table == {"drive": "changed"}
    assert cloud.run(*words).table == {"drive": "done"}


@pytest.mark.parametrize("error", [None, Interrupted(), KeyboardInterrupt(), RecordingError()])
def test_copies_stay_for_an_interrupted_run(
    error: BaseException | None, cloud: Cloud, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the time of change in the store, by which `convert --resume` knows a recording."""
    for name, value in cloud.env.items():
        monkeypatch.setenv(name, value)
    url = "s3://data/raw/a1/drive.pcap"
    raised = contextlib.suppress(Interrupted, KeyboardInterrupt, RecordingError)
    with raised, remote.fetched([url], cache, "user") as copies:
        path = Path(copies[url])
        first = path.stat()
        changed = cloud.client.head_object(Bucket="data", Key="raw/a1/drive.pcap")["LastModified"]
        assert first.st_mtime == changed.timestamp()
        assert {one.name for one in path.parent.iterdir()} == {"drive.pcap", "111.json"}
        if error is not None:
            raise error
    is_interrupted = isinstance(error, (Interrupted, KeyboardInterrupt))
    assert path.exists() == is_interrupted
    with remote.fetched([url], cache, "user"):
        assert (path.stat().st_ctime_ns == first.st_ctime_ns) == is_interrupted
    assert not path.exists()


def test_convert_alone(cloud: Cloud, tmp_path: Path, cache: Path) -> None:
    words = ("s3://data/raw/a1/drive.pcap", "-o", "s3://data/alone/scans.mcap", "--rate", "20")
    ended = cloud.run("convert", *words, "--quiet")
    assert ended.code == 0, ended.err
    lines = ended.err.splitlines()
    assert lines[0].startswith("mlbatch: s3://data/raw/a1/drive.pcap: copied to ")
    assert lines[-1].startswith("mlbatch: uploaded s3://data/alone/scans.mcap (")
    found = cloud.files("alone/")
    assert found["scans.mcap"] == near(cloud, tmp_path / "near.mcap").read_bytes()
    assert set(found) == {"scans.mcap", "scans.mcap.report.json", "scans.mcap.scans.csv"}
    assert not [path for path in cache.rglob("*") if path.is_file()]
    again = cloud.run("convert", *words, "--quiet")
    assert (again.code, len(again.err.splitlines())) == (1, 1)
    assert "--overwrite" in again.err


@pytest.mark.parametrize("kind", ["scans.mcap", "scans"])
def test_digests_of_outputs_on_the_server(kind: str, cloud: Cloud, tmp_path: Path) -> None:
    local = near(cloud, tmp_path / kind, "--split")
    # A folder with folders of sensors, or a file with report and table next to it.
    for path in sorted(tmp_path.rglob("*")):
        if path.is_file():
            cloud.put(f"digest/{path.relative_to(tmp_path).as_posix()}", path)
    url = f"s3://data/digest/{kind}"
    golden = cloud.run("digest", local)
    assert golden.code == 0, golden.err
    assert cloud.run("digest", url) == golden
    (tmp_path / "golden.json").write_text(golden.out, encoding="utf-8")
    against = cloud.run("digest", url, "--against", tmp_path / "golden.json")
    assert (against.code, against.err) == (0, "")
    assert cloud.run("diff", local, url).code == 0


def test_shards_of_a_copied_recording(
    cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("s3://data/raw/a1/drive.pcap", "--rate", "20", "--format", "npz", "-o")
    assert cloud.run("convert", *words, tmp_path / "whole").code == 0
    parts = [tmp_path / "part1", tmp_path / "part2"]
    for number, part in enumerate(parts, 1):
        # Each machine has a cache of its own.
        monkeypatch.setenv("MLBATCH_CACHE", str(tmp_path / f"cache{number}"))
        ended = cloud.run("convert", *words, part, "--shard", f"{number}/2")
        assert ended.code == 0, ended.err
    merged = cloud.run("merge", *parts, "-o", tmp_path / "merged")
    assert merged.code == 0, merged.err
    whole, found = (
        {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "report.json"}
        for folder in (tmp_path / "whole", tmp_path / "merged")
    )
    assert len(whole) > 2
    assert found == whole


def test_files_that_a_recipe_names_are_copied_too(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The calibration of MCD, a folder above its recordings in a store in memory."""
    obstore = pytest.importorskip("obstore")
    store = obstore.store.MemoryStore()
    monkeypatch.setattr(remote, "_store", lambda root: store)
    monkeypatch.chdir(tmp_path)
    made.mcd()
    for path in tmp_path.rglob("*.*"):
        obstore.put(store, f"mcd/{path.relative_to(tmp_path)}", path)
    words = ("ntu_day_01", "--dataset", "mcd", "-o", "near.mcap", "--quiet")
    assert command("convert", *words).code == 0
    calibration = Path("atv_calib.yaml").read_text(encoding="utf-8")
    Path("atv_calib.yaml").unlink()
    url = "s3://data/mcd/ntu_day_01/ntu_day_01_"
    inputs = f"inputs: [{url}os1_128.bag, {url}mid70.bag]"
    manifest = f"schema: mlbatch.batch/1\ndataset: mcd\nsessions: [{{name: day, {inputs}}}]\n"
    Path("many.yaml").write_text(manifest, encoding="utf-8")
    assert command("batch", "many.yaml", "-o", "out").code == 0
    for one, other in zip(
        mlbatch.read("out/day/scans.mcap"), mlbatch.read("near.mcap"), strict=True
    ):
        np.testing.assert_array_equal(one.xyz, other.xyz)
    assert "1 skipped" in command("batch", "many.yaml", "-o", "out").out
    alone = command("convert", f"{url}os1_128.bag", f"{url}mid70.bag", *words[1:4], "alone.mcap")
    assert (alone.code, list(Path(cache, "inputs").iterdir())) == (0, [])
    obstore.put(store, "mcd/atv_calib.yaml", calibration.replace("0.1", "0.3").encode())
    assert "1 done" in command("batch", "many.yaml", "-o", "out").out
    assert next(iter(mlbatch.read("out/day/scans.mcap"))).xyz[0, 1] == pytest.approx(1.3)
    obstore.put(store, "mcd/handheld_calib.yaml", calibration.encode())
    for found in ("atv_calib.yaml, handheld_calib.yaml", "none"):
        failed = command("batch", "many.yaml", "-o", "out", "--retry-failed")
        expected = f"expected one *_calib.yaml in it or a folder above, which {FOLDER}/mcd.yaml"
        assert expected in failed.err
        assert f"found {found}; keep that of the recordings there" in failed.err
        for name in ("atv_calib.yaml", "handheld_calib.yaml"):
            obstore.delete(store, f"mcd/{name}")


def test_a_web_server(cloud: Cloud, tmp_path: Path) -> None:
    """Without lists of files, calibrations are named."""
    server = f"{cloud.env['AWS_ENDPOINT_URL']}/data/raw/a1"
    calibration = cloud.data.folder / "raw" / "a1" / "111.json"
    words = ("--rate", "20", "--metadata", calibration, "--quiet")
    ended = cloud.run("convert", f"{server}/drive.pcap", "-o", tmp_path / "web.mcap", *words)
    assert ended.code == 0, ended.err
    local = near(cloud, tmp_path / "near.mcap", "--metadata", calibration)
    assert (tmp_path / "web.mcap").read_bytes() == local.read_bytes()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("convert", "s3://data/nothing.pcap", "-o", "x.mcap"), 1),
        (("batch", "s3://data/nothing/*.pcap", "-o", "out"), 2),
        (("batch", "https://127.0.0.1:1/*.pcap", "-o", "out"), 2),
        (("convert", "nowhere://data/x.pcap", "-o", "x.mcap"), 2),
        (("batch-status", "s3://data/nothing"), 1),
        (("digest", "s3://data/nothing"), 1),
        (("diff", "s3://data/nothing", "s3://data/nothing"), 1),
    ],
)
def test_mistakes_are_one_line(words: tuple[str, ...], code: int, cloud: Cloud) -> None:
    ended = cloud.run(*words)
    assert (ended.code, ended.out) == (code, "")
    (line,) = ended.err.splitlines()
    assert "expected" in line


def test_missing_credentials_are_an_error_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # An address in the place of the server that gives credentials to machines of the provider.
    monkeypatch.setattr("mlbatch.batch.remote._CREDENTIAL_HOSTS", ("127.0.0.1:1/",))
    monkeypatch.setattr("mlbatch.batch.remote.time.sleep", lambda _: pytest.fail("a second try"))
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:1")
    with pytest.raises(RecordingError, match="expected credentials, found none in the environment"):
        remote.head("s3://a-bucket-without-credentials/drive.pcap")
