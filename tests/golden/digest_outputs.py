"""Digests of what a command wrote: SHA-256 per file, without machine, time and wording.

Two groups. `product`: files that only the packets and the options decide; equal for
any number of jobs and every container. `context`: what names or counts the input: the report, the
receive time at which a scan was ready. Texts of several words are in neither.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from mcap import records
from mcap.stream_reader import StreamReader, get_chunk_data_stream

# Of these records the place alone counts: they hold offsets and checksums, which move with the
# length of the report.
_PLACES = (
    *(records.DataEnd, records.AttachmentIndex, records.MetadataIndex),
    *(records.SummaryOffset, records.Footer),
)
_REPORT = "mlbatch.report"
_READY = "ready_host_ns"
# Times of this run, sizes of containers that other libraries write; figures of linear algebra,
# whose last digits differ from processor to processor (tests/poses has them).
_LEFT_OUT = {"timing", "command", "identity", "poses", "point_times"}


@dataclass(slots=True)
class Digests:
    """Digests by file; about: counts of the output."""

    product: dict[str, str] = field(default_factory=dict)
    context: dict[str, str] = field(default_factory=dict)
    about: str = ""

    def add_folder(self, folder: Path) -> None:
        """All files below a folder."""
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.add_file(path, path.relative_to(folder).as_posix())

    def add_file(self, path: Path, name: str) -> None:
        """One file."""
        data = path.read_bytes()
        if name.endswith("report.json"):
            self._add_report(data.decode(), name)
        elif name.endswith(".csv"):
            product, ready = _split_table(data)
            self.product[name] = _sha256(product)
            self.context[f"{name} {_READY}"] = _sha256(ready)
        elif name.endswith(".mcap"):
            self._add_mcap(data, name)
        elif path.name.startswith("rig"):
            self.add_json(yaml.safe_load(data), name)
        else:
            self.product[name] = _sha256(data)

    def add_json(self, document: Any, name: str) -> None:
        """A JSON document that depends on the input, an entry for each key at its top."""
        for key, value in (document if isinstance(document, dict) else {"": document}).items():
            if key not in _LEFT_OUT:
                text = json.dumps(_without_texts(value))
                self.context[f"{name} {key}".strip()] = _sha256(text.encode())

    def _add_report(self, text: str, name: str) -> None:
        report = json.loads(text)
        # Sizes of containers that are written by libraries change with these.
        for one in report.get("inputs", ()):
            one.pop("bytes", None)
        scans = report.get("scans", {})
        self.about = f"{scans.get('written')} scans, {scans.get('points')} points"
        self.add_json(report, name)

    def _add_mcap(self, data: bytes, name: str) -> None:
        """Records in their order; the bytes of a compressor change with its version."""
        digest = hashlib.sha256()
        for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
            digest.update(type(record).__name__.encode())
            if isinstance(record, records.Chunk):
                digest.update(repr(replace(record, data=b"")).encode())
                stream, size = get_chunk_data_stream(record)
                digest.update(stream.read(size))
            elif isinstance(record, records.Metadata) and record.name == _REPORT:
                self._add_report(record.metadata["json"], f"{name} {_REPORT}")
            elif isinstance(record, records.Attachment):
                product, _ = _split_table(record.data)
                digest.update(repr(replace(record, data=product)).encode())
            elif not isinstance(record, _PLACES) and not (
                # Offsets change with the compressor.
                isinstance(record, records.ChunkIndex) and record.compression
            ):
                digest.update(repr(record).encode())
        self.product[name] = digest.hexdigest()


def _without_texts(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_texts(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_without_texts(one) for one in value]
    return "(text)" if isinstance(value, str) and len(value.split()) > 1 else value


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _split_table(data: bytes) -> tuple[bytes, bytes]:
    """scans.csv without the receive times, and these."""
    rows = list(csv.reader(io.StringIO(data.decode())))
    at = rows[0].index(_READY) if rows and _READY in rows[0] else len(rows[0])
    ready = "\n".join(row[at] if at < len(row) else "" for row in rows)
    product = "\n".join(",".join(row[:at] + row[at + 1 :]) for row in rows)
    return product.encode(), ready.encode()
