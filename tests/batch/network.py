"""An S3-compatible server on loopback with a data set, and a network to it that can be cut."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.batch.sessions import Dataset, Ended

CUT_S = 1.5


class Network:
    """Forwards connections to a port.

    cut_after: bytes to clients and to the server, after which it is cut once for CUT_S.
    """

    def __init__(self, port: int) -> None:
        self._to = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.cut_after: dict[str, int] = {}
        self._until_s = 0.0
        self._open: set[socket.socket] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            if time.monotonic() < self._until_s:
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", self._to))
            self._open |= {near, far}
            for pair in ((near, far, "to server"), (far, near, "to client")):
                threading.Thread(target=self._forward, args=pair, daemon=True).start()

    def _forward(self, one: socket.socket, other: socket.socket, way: str) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(1 << 14):
                other.sendall(data)
                if way in self.cut_after:
                    self.cut_after[way] -= len(data)
                    if self.cut_after[way] <= 0:
                        del self.cut_after[way]
                        self._cut()
        for each in (one, other):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _cut(self) -> None:
        self._until_s = time.monotonic() + CUT_S
        for each in list(self._open):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        self._open.clear()

    def close(self) -> None:
        """Forward nothing more."""
        self._listener.close()


@dataclass(frozen=True, slots=True)
class Cloud:
    """The server with a data set under s3://data/raw; env: for clients."""

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
            env=self.data.env | self.env,
            check=False,
        )
        return Ended(done.returncode, done.stdout, done.stderr)

    def put(self, name: str, path: Path) -> None:
        """Store a file, also for clients without credentials."""
        self.client.upload_file(str(path), "data", name, ExtraArgs={"ACL": "public-read"})

    def files(self, prefix: str) -> dict[str, bytes]:
        """Content of the objects below a prefix."""
        pages = self.client.get_paginator("list_objects_v2").paginate(Bucket="data", Prefix=prefix)
        names = [one["Key"] for page in pages for one in page.get("Contents", [])]
        return {
            name.removeprefix(prefix): self.client.get_object(Bucket="data", Key=name)[
                "Body"
            ].read()
            for name in names
        }


@contextlib.contextmanager
def cloud_of(data: Dataset) -> Iterator[Cloud]:
    """A server behind a network; the test is skipped without the extras."""
    needed = "needs the extra dev-integrations (an S3 server)"
    pytest.importorskip("obstore")
    server_module = pytest.importorskip("moto.server", reason=needed)
    boto3 = pytest.importorskip("boto3", reason=needed)
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    network = Network(port)
    url = f"http://127.0.0.1:{network.port}"
    env = {
        "AWS_ENDPOINT_URL": url,
        "AWS_ENDPOINT": url,
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
    }
    client = boto3.client(
        "s3",
        endpoint_url=url,
        aws_access_key_id="test",
        aws_secret_access_key="test",
        region_name="us-east-1",
    )
    client.create_bucket(Bucket="data")
    cloud = Cloud(network, env, client, data)
    for path in (data.folder / "raw").rglob("*"):
        if path.is_file():
            cloud.put(path.relative_to(data.folder).as_posix(), path)
    try:
        yield cloud
    finally:
        network.close()
        server.stop()
