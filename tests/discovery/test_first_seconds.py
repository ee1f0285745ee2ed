"""The first seconds of a session: read once, and kept where that is little."""

from __future__ import annotations

import json
from collections.abc import Generator
from pathlib import Path

import pytest

from mlbatch.discovery import first_seconds
from mlbatch.discovery.first_seconds import FirstSeconds, is_without_packets
from mlbatch.readers import open_recording
from mlbatch.readers.capture.recording import CaptureRecording
from mlbatch.types import PacketBatch, StreamTable
from tests.builders.sessions import FIXTURE, Shell, Unit, write_session

CAPTURE = FIXTURE / "two_lidars.pcap"
RUN = f"convert {CAPTURE} --rig {FIXTURE / 'rig.yaml'} --dry-run --quiet"


def _first(path: Path) -> FirstSeconds:
    table = StreamTable()
    return FirstSeconds([open_recording(path, table)], table)


@pytest.mark.parametrize(
    "arguments",
    [
        RUN,
        f"{RUN} --align-clocks",
        f"inspect {CAPTURE} --json",
        f"inspect {CAPTURE} --json --whole",
    ],
)
def test_a_short_capture_is_read_once(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, arguments: str
) -> None:
    """And what it gives is that of a capture that is read again."""
    passes: list[Path] = []
    packets = CaptureRecording.packets

    def counted(recording: CaptureRecording) -> Generator[PacketBatch, None, None]:
        passes.append(recording.path)
        return packets(recording)

    monkeypatch.setattr(CaptureRecording, "packets", counted)
    once = shell(arguments)
    assert once.code == 0
    assert len(passes) == 1
    monkeypatch.setattr(first_seconds, "KEPT_BYTES", 0)
    again = shell(arguments)
    assert len(passes) > 2
    documents = [json.loads(outcome.out) for outcome in (once, again)]
    for document in documents:
        document.pop("timing", None)
    assert documents[0] == documents[1]


def test_a_longer_capture_is_read_again(tmp_path: Path) -> None:
    """Of 12 s ten are sampled; all are in the whole."""
    unit = Unit(turns=120)
    capture = write_session(tmp_path, unit)
    first = _first(capture)
    assert not first.has_all
    (samples,) = first.sampler.kinds.values()
    # 32 packets a revolution of 0.1 s, and the packet at 10 s.
    assert samples.packets == 100 * 32 + 1
    read = list(first.again(is_without_packets, None))
    assert sum(map(len, read)) == samples.packets
    assert sum(map(len, first.whole())) == 120 * 32


def test_what_is_kept_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = write_session(tmp_path, Unit(turns=4))
    size = sum(int(batch.size.sum()) for batch in _first(capture).whole())
    for most, is_kept in ((size - 1, False), (size, True)):
        monkeypatch.setattr(first_seconds, "KEPT_BYTES", most)
        assert _first(capture).has_all is is_kept
