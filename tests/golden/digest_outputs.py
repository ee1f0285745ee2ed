"""Digests of what a command wrote: SHA-256 per file, without machine, time and wording.

Two groups. `product`: files that only the packets and the options decide; equal for
any number of jobs and every container. `context`: what names or counts the input: the report, the
receive time at which a scan was ready. Texts of several words are kept apart, in neither.
"""

from __future__ import annotations

import csv
import hashlib
import importlib
import io
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
import zstandard

# Of records of these kinds the place alone counts: they hold offsets and checksums, which move
# with the length of the report.
_END_OF_DATA = 15
_ATTACHMENT_INDEX = 10
_METADATA_INDEX = 13
_SUMMARY_OFFSET = 14
_FOOTER = 2
_PLACES = {_END_OF_DATA, _ATTACHMENT_INDEX, _METADATA_INDEX, _SUMMARY_OFFSET, _FOOTER}
_CHUNK = 6
_CHUNK_INDEX = 8
_ATTACHMENT = 9
_METADATA = 12
_MAGIC_BYTES = 8
_REPORT = "mlbatch.report"
_READY = "ready_host_ns"
# Times of this run, sizes of containers that other libraries write; figures of linear algebra,
# whose last digits differ from processor to processor (tests/poses has them).
_LEFT_OUT = {"timing", "command", "identity", "poses", "point_times"}


@dataclass(slots=True)
class Digests:
    """Digests by file; texts: by the keys that lead to them, without numbers of list items."""

    product: dict[str, str] = field(default_factory=dict)
    context: dict[str, str] = field(default_factory=dict)
    texts: dict[str, set[str]] = field(default_factory=dict)
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
            self._add_table(data, name)
        elif name.endswith(".mcap"):
            self._add_mcap(data, name)
        elif path.name.startswith("rig"):
            self.add_json(yaml.safe_load(data), name)
        else:
            self.product[name] = _sha256(data)

    def add_json(self, document: Any, name: str) -> None:
        """A JSON document that depends on the input, an entry for each key at its top."""
        if not isinstance(document, dict):
            document = {"": document}
        for key, value in document.items():
            if key not in _LEFT_OUT:
                bare = self._without_texts(value, f"{name} {key}".strip())
                entry = f"{name} {key}".strip()
                self.context[entry] = _sha256(json.dumps(bare).encode())

    def _add_report(self, text: str, name: str) -> None:
        report = json.loads(text)
        # Sizes of containers that are written by libraries change with these.
        for one in report.get("inputs", ()):
            one.pop("bytes", None)
        scans = report.get("scans", {})
        self.about = f"{scans.get('written')} scans, {scans.get('points')} points"
        self.add_json(report, name)

    def _add_table(self, data: bytes, name: str) -> None:
        product, ready = _split_table(data)
        self.product[name] = _sha256(product)
        self.context[f"{name} {_READY}"] = _sha256(ready)

    def _add_mcap(self, data: bytes, name: str) -> None:
        digest = hashlib.sha256(data[:_MAGIC_BYTES])
        for opcode, content in _records(data):
            digest.update(bytes([opcode]))
            if opcode == _CHUNK:
                digest.update(_chunk(content))
            elif opcode == _METADATA:
                key, at = _string(content, 0)
                if key == _REPORT:
                    values = _string_map(content, at)
                    self._add_report(values.pop("json"), f"{name} {_REPORT}")
                    digest.update(repr(sorted(values)).encode())
                else:
                    digest.update(content)
            elif opcode == _ATTACHMENT:
                digest.update(_attachment(content))
            elif opcode not in _PLACES and not (opcode == _CHUNK_INDEX and _is_compressed(content)):
                digest.update(content)
        self.product[name] = digest.hexdigest()

    def _without_texts(self, value: Any, keys: str) -> Any:
        if isinstance(value, dict):
            return {
                key: self._without_texts(one, f"{keys}.{key}".strip("."))
                for key, one in value.items()
            }
        if isinstance(value, list):
            return [self._without_texts(one, keys) for one in value]
        if isinstance(value, str) and len(value.split()) > 1:
            self.texts.setdefault(keys, set()).add(value)
            return "(text)"
        return value


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _split_table(data: bytes) -> tuple[bytes, bytes]:
    """scans.csv without the receive times, and these."""
    rows = list(csv.reader(io.StringIO(data.decode())))
    at = rows[0].index(_READY) if rows and _READY in rows[0] else len(rows[0])
    ready = "\n".join(row[at] if at < len(row) else "" for row in rows)
    product = "\n".join(",".join(row[:at] + row[at + 1 :]) for row in rows)
    return product.encode(), ready.encode()


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of an MCAP file."""
    at = _MAGIC_BYTES
    while at < len(data) - _MAGIC_BYTES:
        opcode, length = struct.unpack_from("<BQ", data, at)
        at += 9
        yield opcode, data[at : at + length]
        at += length


def _string(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length


def _string_map(content: bytes, at: int) -> dict[str, str]:
    found = {}
    at += 4
    while at < len(content):
        key, at = _string(content, at)
        found[key], at = _string(content, at)
    return found


def _chunk(content: bytes) -> bytes:
    """Times, size, checksum and records; the bytes of a compressor change with its version."""
    head = content[:28]
    compression, at = _string(content, 28)
    records = content[at + 8 :]
    if compression == "zstd":
        records = zstandard.ZstdDecompressor().decompressobj().decompress(records)
    elif compression == "lz4":
        records = importlib.import_module("lz4.frame").decompress(records)
    return head + compression.encode() + records


def _is_compressed(content: bytes) -> bool:
    """Whether the index is that of a compressed chunk: its offsets change with the compressor."""
    (offsets,) = struct.unpack_from("<I", content, 32)
    compression, _ = _string(content, 36 + offsets + 8)
    return compression != ""


def _attachment(content: bytes) -> bytes:
    """Times, name, media type and the table without receive times."""
    name, at = _string(content, 16)
    kind, at = _string(content, at)
    (length,) = struct.unpack_from("<Q", content, at)
    product, _ = _split_table(content[at + 8 : at + 8 + length])
    return content[:16] + name.encode() + kind.encode() + product
