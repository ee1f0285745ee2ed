"""Batches and conversions from and to an S3-compatible server, with a network that is cut."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from mlbatch.batch import remote
from mlbatch.errors import RecordingError
from tests.batch.network import Network, s3_server
from tests.batch.sessions import Dataset, Ended, run, scans, write_dataset
from tests.builders.run import ROOT

NEEDED = "needs the extra dev-integrations (an S3 server)"
pytest.importorskip("obstore")
pytest.importorskip("moto", reason=NEEDED)
pytest.importorskip("flask_cors", reason=NEEDED)
boto3: Any = importlib.import_module("boto3")

NAMES = ["a1", "a2", "b1", "hopeless"]


@dataclass(frozen=True, slots=True)
class Cloud:
    """The server with a dataset under s3://data/raw."""

    network: Network
    env: dict[str, str]
    client: Any
    data: Dataset

    def run(self, *words: str | Path) -> Ended:
        """`mlbatch WORDS` in a process of its own."""
        done = subprocess.run(
            [sys.executable, "-m", "mlbatch", *map(str, words)],
            capture_output=True,
            text=True,
            env=os.environ | self.env | {"PYTHONPATH": str(ROOT)},
            check=False,
        )
        return Ended(done.returncode, done.stdout, done.stderr)

    def files(self, prefix: str) -> dict[str, bytes]:
        """Content of the objects below a prefix."""
        listed = self.client.list_objects_v2(Bucket="data", Prefix=prefix).get("Contents", [])
        return {
            one["Key"].removeprefix(prefix): self.client.get_object(Bucket="data", Key=one["Key"])[
                "Body"
            ].read()
            for one in listed
        }


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cloud]:
    data = write_dataset(tmp_path_factory.mktemp("cloud") / "data", NAMES)
    with s3_server() as (network, env):
        client = boto3.client(
            "s3",
            endpoint_url=env["AWS_ENDPOINT_URL"],
            aws_access_key_id="test",
            aws_secret_access_key="test",
            region_name="us-east-1",
        )
        client.create_bucket(Bucket="data")
        for path in (data.folder / "raw").rglob("*"):
            if path.is_file():
                key = path.relative_to(data.folder).as_posix()
                # Also for clients without credentials.
                client.upload_file(str(path), "data", key, ExtraArgs={"ACL": "public-read"})
        yield Cloud(network, env, client, data)


@pytest.fixture(scope="module")
def local(cloud: Cloud, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The outputs of the same sessions on a local disk."""
    out = tmp_path_factory.mktemp("local") / "out"
    assert run(cloud.data, out, "--workers", "2").code == 3
    return scans(out)


def outputs(files: dict[str, bytes]) -> dict[str, bytes]:
    """The scans among the files of a batch."""
    return {name: data for name, data in files.items() if "/scans" in name}


@pytest.mark.parametrize("cut_after", [None, 300_000, 700_000])
def test_from_and_to_the_server(
    cut_after: int | None, cloud: Cloud, local: dict[str, bytes], tmp_path: Path
) -> None:
    """The network is cut while recordings are read, or while outputs are written."""
    prefix = f"out-{cut_after}/"
    places = ("s3://data/raw/*/", "-o", f"s3://data/{prefix}", "--cache", tmp_path / "cache")
    words = (*places, "--rate", "20", "--workers", "2")
    cuts = cloud.network.cuts
    cloud.network.cut_after = cut_after
    ended = cloud.run("batch", *words)
    assert cloud.network.cuts - cuts == (cut_after is not None)
    assert ended.code == 3, ended.err
    states = {"a1": "done", "a2": "done", "b1": "done"}
    # A folder without recordings is no session, one with another file of such a name fails.
    assert ended.table == states | {"hopeless": "failed"}
    found = cloud.files(prefix)
    assert outputs(found) == local
    for name in states:
        assert json.loads(found[f"{name}/session.json"])["state"] == "done"
    assert not [name for name in found if "started" in name or "partial" in name]
    # Outputs are removed from the cache once they are uploaded.
    assert not list((tmp_path / "cache" / "outputs").rglob("scans*"))

    again = cloud.run("batch", *words)
    assert again.code == 3
    assert again.table == dict.fromkeys(states, "skipped") | {"hopeless": "failed"}
    status = json.loads(cloud.run("batch-status", f"s3://data/{prefix}", "--json").out)
    assert status["states"] == {"done": 3, "failed": 1, "unfinished": 0}


def test_another_server_of_files_is_a_changed_input(cloud: Cloud, tmp_path: Path) -> None:
    data = (cloud.data.folder / "raw" / "a1" / "drive.pcap").read_bytes()
    cloud.client.put_object(Bucket="data", Key="new/a1/drive.pcap", Body=data)
    meta = (cloud.data.folder / "raw" / "a1" / "111.json").read_bytes()
    cloud.client.put_object(Bucket="data", Key="new/a1/111.json", Body=meta)
    places = ("-o", tmp_path / "out", "--cache", tmp_path / "cache")
    words = ("batch", "s3://data/new/a1/*.pcap", *places)
    assert cloud.run(*words).table == {"drive": "done"}
    assert cloud.run(*words).table == {"drive": "skipped"}
    cloud.client.put_object(Bucket="data", Key="new/a1/drive.pcap", Body=data[:-3000])
    assert cloud.run(*words).table == {"drive": "done"}


def test_the_cache_has_a_limit(cloud: Cloud, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    sizes = [(cloud.data.folder / "raw" / name / "drive.pcap").stat().st_size for name in ("a1",)]
    limit = 1.5 * sizes[0]
    words = ("s3://data/raw/[ab]?/", "-o", tmp_path / "out", "--cache", cache)
    ended = cloud.run("batch", *words, "--cache-gb", f"{limit / 1e9:.9f}")
    assert ended.code == 0, ended.out
    kept = sum(path.stat().st_size for path in (cache / "inputs").rglob("*.pcap"))
    assert 0 < kept <= limit
    small = cloud.run("batch", *words, "--cache-gb", "0.000001", "--rate", "5")
    assert small.code == 3
    assert "--cache-gb" in small.out


def test_convert_alone(cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLBATCH_CACHE", str(tmp_path / "cache"))
    words = ("s3://data/raw/a1/drive.pcap", "-o", "s3://data/alone/scans.mcap", "--rate", "20")
    ended = cloud.run("convert", *words, "--quiet")
    assert ended.code == 0, ended.err
    lines = ended.err.splitlines()
    assert lines[0].startswith("mlbatch: s3://data/raw/a1/drive.pcap: copied to ")
    assert lines[-1].startswith("mlbatch: uploaded s3://data/alone/scans.mcap (")
    near = tmp_path / "near.mcap"
    capture = cloud.data.folder / "raw" / "a1" / "drive.pcap"
    assert cloud.run("convert", capture, "-o", near, "--rate", "20", "--quiet").code == 0
    found = cloud.files("alone/")
    assert found["scans.mcap"] == near.read_bytes()
    assert set(found) == {"scans.mcap", "scans.mcap.report.json", "scans.mcap.scans.csv"}
    again = cloud.run("convert", *words, "--quiet")
    assert (again.code, len(again.err.splitlines())) == (1, 1)
    assert "--overwrite" in again.err


@pytest.mark.parametrize("kind", ["scans.mcap", "scans"])
def test_digests_of_outputs_on_the_server(kind: str, cloud: Cloud, tmp_path: Path) -> None:
    capture = cloud.data.folder / "raw" / "a1" / "drive.pcap"
    near = tmp_path / kind
    words = (capture, "-o", near, "--rate", "20", "--split", "--quiet")
    assert cloud.run("convert", *words).code == 0
    # A folder with folders of sensors, or a file with report and table next to it.
    for path in sorted(tmp_path.rglob("*")):
        if path.is_file():
            key = f"digest/{path.relative_to(tmp_path).as_posix()}"
            cloud.client.upload_file(str(path), "data", key)
    url = f"s3://data/digest/{kind}"
    golden = cloud.run("digest", near)
    assert golden.code == 0, golden.err
    assert cloud.run("digest", url) == golden
    (tmp_path / "golden.json").write_text(golden.out, encoding="utf-8")
    against = cloud.run("digest", url, "--against", tmp_path / "golden.json")
    assert (against.code, against.err) == (0, "")
    assert cloud.run("diff", near, url).code == 0


def test_shards_of_a_copied_recording(
    cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("s3://data/raw/a1/drive.pcap", "--rate", "20", "--format", "npz", "-o")
    monkeypatch.setenv("MLBATCH_CACHE", str(tmp_path / "cache"))
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


def test_a_web_server(cloud: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without lists of files, calibrations are named."""
    monkeypatch.setenv("MLBATCH_CACHE", str(tmp_path / "cache"))
    server = f"{cloud.env['AWS_ENDPOINT_URL']}/data/raw/a1"
    folder = cloud.data.folder / "raw" / "a1"
    words = ("--rate", "20", "--metadata", folder / "111.json", "--quiet")
    ended = cloud.run("convert", f"{server}/drive.pcap", "-o", tmp_path / "web.mcap", *words)
    assert ended.code == 0, ended.err
    near = tmp_path / "near.mcap"
    assert cloud.run("convert", folder / "drive.pcap", "-o", near, *words).code == 0
    assert (tmp_path / "web.mcap").read_bytes() == near.read_bytes()


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
