"""Checksums of scans.csv: changes of values that break no other law."""

from __future__ import annotations

import csv
import importlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from mlbatch.decode.decoder import Decoder
from mlbatch.pipeline import conversion
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.decode_pool import Decoded, DecodeTask, DecodeWorker
from mlbatch.types import Scan
from mlbatch.verification import verify
from tests.builders.run import TWO_LIDARS, command
from tests.builders.verify_outputs import COMMON, KINDS, copied, damaged, made
from tests.verification.edits import edit_of


def scaled(scan: Scan) -> None:
    """Coordinates times 1.001."""
    scan.xyz[:] *= 1.001


def dark(scan: Scan) -> None:
    """All intensities 0, but those of empty slots."""
    scan.intensity[scan.intensity > 0] = 0
    if scan.reflectivity is not None:
        scan.reflectivity[:] = 0


CHANGES: dict[str, Callable[[Scan], None]] = {"coordinates": scaled, "intensities": dark}
# Layouts without intensities, or with angles that `geometry` compares with coordinates.
OTHERS = {
    ("minimal.mcap", "intensities"),
    ("ply-float", "intensities"),
    ("autoware.mcap", "coordinates"),
}


def needs_las(kind: str) -> None:
    """Skip LAS and LAZ without their packages."""
    if kind in ("las", "laz"):
        pytest.importorskip("laspy")
        pytest.importorskip("lazrs")


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", KINDS)
def test_other_values_in_a_sound_file_are_found(
    kind: str, change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All else of the output is as it should be: its format, table and report."""
    if (kind, change) in OTHERS:
        pytest.skip("a layout without this value")
    needs_las(kind)
    rows = list(csv.DictReader(io.StringIO(table_of(made(kind)))))
    sums: Iterator[int] = iter([int(row["checksum"]) for row in rows])
    decode = DecodeWorker.decode
    account = Conversion.account
    seen: set[tuple[int, int]] = set()

    def changed(worker: DecodeWorker, task: DecodeTask, counts_points: bool = False) -> Decoded:
        found = decode(worker, task, counts_points=counts_points)
        CHANGES[change](found.scan)
        return found

    def as_before(
        run: Conversion, scan: Scan, checksum: int | None = None, is_listed: bool = True
    ) -> None:
        key = (scan.index, scan.slice)
        account(run, scan, 0 if key in seen else next(sums), is_listed)
        seen.add(key)

    # Without the layout of records, so that scans have arrays.
    monkeypatch.setattr(conversion, "Decoder", lambda *words, **own: Decoder(*words[:6], **own))
    monkeypatch.setattr(DecodeWorker, "decode", changed)
    monkeypatch.setattr(Conversion, "account", as_before)
    target = tmp_path / kind
    words = (TWO_LIDARS / "two_lidars.pcap", "--rig", TWO_LIDARS / "rig.yaml", "-o", target)
    done = command("convert", *words, *COMMON, *KINDS[kind], "--jobs", "1")
    assert (done.code, done.err) == (0, "")
    verdict = verify(target)
    assert {one.check for one in verdict.violations} == {"checksum"}
    assert "scans.csv line 2 checksum" in verdict.violations[0].where


def table_of(output: Path) -> str:
    """The text of scans.csv."""
    path = output / "scans.csv"
    path = path if output.is_dir() else output.with_name(f"{output.name}.scans.csv")
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("place", [0.35, 0.6, 0.85])
@pytest.mark.parametrize("kind", KINDS)
def test_one_changed_byte_is_found(kind: str, place: float, tmp_path: Path) -> None:
    needs_las(kind)
    output = copied(kind, tmp_path)
    names = ("000001*", "right/000001*", "*.mcap")
    files = [one for name in names for one in output.glob(name)] if output.is_dir() else [output]
    for path in files:
        sound = path.read_bytes()
        # The lowest bit: a number stays a number.
        at = int(len(sound) * place)
        path.write_bytes(sound[:at] + bytes([sound[at] ^ 1]) + sound[at + 1 :])
        assert not verify(output).ok, path
        path.write_bytes(sound)
    assert verify(output).ok


def test_the_sum_is_that_of_the_document() -> None:
    """CRC-32 of a file as any other program computes it, here that of gzip (RFC 1952)."""
    gzip = importlib.import_module("gzip")
    path = made("ply")
    expected = int.from_bytes(gzip.compress((path / "000001.ply").read_bytes())[-8:-4], "little")
    rows = list(csv.DictReader(io.StringIO(table_of(path))))
    assert [int(one["checksum"]) for one in rows if one["index"] == "1"] == [expected]


def test_a_table_of_an_earlier_version_has_none(tmp_path: Path) -> None:
    def without(path: Path) -> None:
        lines = list(csv.reader(io.StringIO(table_of(path))))
        at = lines[0].index("checksum")
        text = "".join(",".join([*line[:at], *line[at + 1 :]]) + "\n" for line in lines)
        (path / "scans.csv").write_text(text, encoding="utf-8")

    verdict = damaged("ply", tmp_path, without)
    assert verdict.ok
    (check,) = [one for one in verdict.checks if one.name == "checksum"]
    assert check.outcome == "not checkable"
    assert "earlier version" in check.limit


def test_an_output_without_a_table_is_not_checkable(tmp_path: Path) -> None:
    output = copied("scans.bag", tmp_path)
    output.with_name("scans.bag.scans.csv").unlink()
    (check,) = [one for one in verify(output).checks if one.name == "checksum"]
    assert check.outcome == "not checkable"
    assert "no scans.csv" in check.limit


def test_an_unknown_checksum_is_not_compared(tmp_path: Path) -> None:
    """As of a writer of another package, which gives none."""
    text = table_of(made("ply"))
    sums = [line.split(",")[-2] for line in text.splitlines()[1:]]
    unknown = edit_of("; ".join(f"text scans.csv ,{one}, ,-1," for one in sums))
    verdict = damaged("ply", tmp_path, unknown)
    assert verdict.ok
    (check,) = [one for one in verdict.checks if one.name == "checksum"]
    assert check.outcome == "not checkable"
