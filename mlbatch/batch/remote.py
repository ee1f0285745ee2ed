"""Files in object storage and on web servers: described, listed, copied here and back.

obstore (object_store) reads s3://, gs://, az:// and https://; credentials and endpoints are those
of its environment variables (AWS_..., GOOGLE_..., AZURE_...).
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import importlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from mlbatch.errors import (
    ExportError,
    Interrupted,
    MlbatchError,
    RecordingError,
    UsageError,
    install_extra,
)

T = TypeVar("T")

_WILD = re.compile(r"[*?\[]")
_WEB = ("http", "https")
# Bytes of a request; one that fails is repeated, not the whole file.
_BLOCK_BYTES = 8 << 20
# Machines of the providers ask these for credentials, if the environment has none.
_CREDENTIAL_HOSTS = ("169.254.169.254", "metadata.google.internal")
# Waits between attempts, s: a network that is cut for a minute is no failure.
_WAITS_S = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
_TIMEOUT = "60s"


class RemoteFile(NamedTuple):
    """A file of a store; version: changes with its content; changed_ns: time of that."""

    url: str
    size: int
    version: str
    changed_ns: int = 0

    @property
    def name(self) -> str:
        """The last part of its URL."""
        return self.url.rpartition("/")[2]


# -- stores -----------------------------------------------------------------------------------


class _Place(NamedTuple):
    store: Any
    root: str  # scheme://bucket
    path: str


def _place(url: str) -> _Place:
    """The store of a URL; UsageError without obstore."""
    scheme, _, rest = url.partition("://")
    bucket, _, path = rest.partition("/")
    root = f"{scheme}://{bucket}"
    return _Place(_store(root), root, path)


def check_package(url: str) -> None:
    """Raise UsageError without obstore."""
    try:
        importlib.import_module("obstore.store")
    except ImportError as err:
        raise UsageError(
            f"{url}: expected the package obstore for URLs, found none ({err}); "
            f"{install_extra('remote')}"
        ) from err


@lru_cache(maxsize=64)
def _store(root: str) -> Any:
    check_package(root)
    from obstore.store import from_url

    allows_http = root.startswith("http://") or os.environ.get("AWS_ALLOW_HTTP") == "true"
    retry = {"max_retries": 2, "retry_timeout": timedelta(seconds=10)}
    options = {"timeout": _TIMEOUT, "connect_timeout": "10s", "allow_http": allows_http}
    try:
        return from_url(root, client_options=options, retry_config=retry)
    except Exception as err:
        raise UsageError(
            f"{root}: expected a URL of object storage (s3, gs, az) or https, found "
            f"{_first_line(err)}; check it"
        ) from err


def _request(url: str, call: Callable[[Any, _Place], T]) -> T:
    """Repeat a request until it succeeds; RecordingError in the end, or at once if it is final.

    call: with the package obstore, and the place of the URL.
    """
    place = _place(url)
    import obstore

    for wait_s in (*_WAITS_S, None):
        try:
            return call(obstore, place)
        except Exception as err:
            if isinstance(err, MlbatchError):
                raise
            if any(host in str(err) for host in _CREDENTIAL_HOSTS):
                raise RecordingError(
                    f"{url}: expected credentials, found none in the environment; set them "
                    "(AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, GOOGLE_SERVICE_ACCOUNT, "
                    "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY)"
                ) from err
            is_final = isinstance(err, FileNotFoundError) or type(err).__name__ in (
                *("NotFoundError", "PermissionDeniedError", "UnauthenticatedError"),
                *("InvalidPathError", "NotSupportedError", "NotImplementedError"),
            )
            if is_final or wait_s is None:
                raise RecordingError(
                    f"{url}: expected to reach it, found {_first_line(err)}; check the name, the "
                    "network, and credentials and endpoint (environment)"
                ) from err
        time.sleep(wait_s)
    raise AssertionError("unreachable")


def _first_line(err: Exception) -> str:
    return next(iter(str(err).strip().splitlines()), type(err).__name__)[:300]


# -- description ------------------------------------------------------------------------------


def head(url: str) -> RemoteFile:
    """Size and version of a file; RecordingError without one."""
    found = _request(url, lambda obstore, place: obstore.head(place.store, place.path))
    return _remote_file("", found, url)


def _remote_file(root: str, meta: Any, url: str = "") -> RemoteFile:
    changed = meta["last_modified"]
    version = str(meta.get("e_tag") or changed)
    changed_ns = int(changed.timestamp()) * 1_000_000_000
    return RemoteFile(url or f"{root}/{meta['path']}", int(meta["size"]), version, changed_ns)


def listed(url: str, *, is_deep: bool = True) -> list[RemoteFile]:
    """All files below a folder, or right in it, by name; none of a web server: it has no lists."""
    if url.partition("://")[0] in _WEB:
        return []

    def pages(obstore: Any, place: _Place) -> list[RemoteFile]:
        prefix = place.path.rstrip("/") or None
        if is_deep:
            batches = obstore.list(place.store, prefix=prefix)
        else:
            batches = [obstore.list_with_delimiter(place.store, prefix=prefix)["objects"]]
        return [_remote_file(place.root, meta) for batch in batches for meta in batch]

    return sorted(_request(f"{url.rstrip('/')}/", pages))


def with_calibrations(urls: Sequence[str]) -> list[RemoteFile]:
    """Files, and the calibrations next to them."""
    files = [head(url) for url in urls]
    near = [one for url in urls for one in calibrations(url)]
    return list({one.url: one for one in (*files, *near)}.values())


def named_by_recipe(urls: Sequence[str], rig: Path | None) -> dict[tuple[str, str], RemoteFile]:
    """Files that a recipe names, by the folder of a recording and their path in a copy of it.

    They are searched as for local recordings: in its folder, or up to two above. Raises
    RecordingError where one lacks, or is not the only one.
    """
    from mlbatch.rig.recipes import LEVELS, named_files

    found = {}
    for node in [] if rig is None else named_files(rig):
        for folder in dict.fromkeys(url.rpartition("/")[0] for url in urls):
            # Not above the bucket.
            ends = [folder, *(folder.rsplit("/", at)[0] for at in range(1, LEVELS))]
            places = [end for end in ends if end.count("/") > 1]
            matches = next(filter(None, (_named(place, node.text) for place in places)), [])
            if len(matches) != 1:
                shown = ", ".join(one.name for one in matches) or "none"
                raise RecordingError(
                    f"{folder}: expected one {node.text} in it or a folder above, which "
                    f"{node.place} names, found {shown}; keep that of the recordings there"
                )
            parent = node.text.rpartition("/")[0]
            found[folder, f"{parent}/{matches[0].name}".lstrip("/")] = matches[0]
    return found


def _named(folder: str, name: str) -> list[RemoteFile]:
    """Files of a name, or a pattern, in a folder."""
    if folder.partition("://")[0] in _WEB:
        with contextlib.suppress(RecordingError):
            return [head(f"{folder}/{name}")]
        return []
    parent, _, pattern = f"{folder}/{name}".rpartition("/")
    return [one for one in listed(parent, is_deep=False) if fnmatch.fnmatchcase(one.name, pattern)]


def calibrations(url: str) -> list[RemoteFile]:
    """Files in the folder of a recording that may be calibrations, as `convert` looks for them."""
    from mlbatch.discovery.calibrations import CALIBRATION_SUFFIXES, MAX_CALIBRATION_FILE_BYTES

    return [
        one
        for one in listed(url.rpartition("/")[0], is_deep=False)
        if one.name.lower().endswith(CALIBRATION_SUFFIXES)
        and one.size <= MAX_CALIBRATION_FILE_BYTES
    ]


def matching(pattern: str) -> list[str]:
    """URLs of files, or of folders where the pattern ends with a slash."""
    if pattern.partition("://")[0] in _WEB:
        raise UsageError(
            f"{pattern}: expected a URL without pattern, since web servers have no lists of files, "
            "found one; name the files"
        )
    wild = _WILD.search(pattern)
    folder = pattern[: wild.start() if wild else None].rpartition("/")[0]
    is_folder = pattern.endswith("/")
    expected = pattern.rstrip("/").split("/")
    found = set()
    for one in listed(folder):
        parts = one.url.split("/")
        names = parts[: len(expected)]
        # A star does not match a slash.
        is_match = len(names) == len(expected) and all(map(fnmatch.fnmatchcase, names, expected))
        if is_match and is_folder == (len(parts) > len(names)):
            found.add("/".join(names) + "/" * is_folder)
    return sorted(found)


# -- copies -----------------------------------------------------------------------------------


def default_cache() -> Path:
    """`$MLBATCH_CACHE`, or the usual place of the user."""
    named = os.environ.get("MLBATCH_CACHE")
    if named:
        return Path(named)
    usual = os.environ.get("XDG_CACHE_HOME")
    return (Path(usual) if usual else Path.home() / ".cache") / "mlbatch"


@contextlib.contextmanager
def fetched(
    urls: Sequence[str], cache: Path, user: object, rig: Path | None = None
) -> Iterator[dict[str, str]]:
    """Paths of local copies of files, by URL; calibrations lie next to them. Removed at the end.

    user: what the copies are for; only one process uses them at a time; rig: may be a recipe, whose
    files are copied, too. Copies of an interrupted run stay for the next one. Other versions of the
    files have another folder.
    """
    files = with_calibrations(urls)
    named = named_by_recipe(urls, rig)
    folder = cache / "inputs" / digest_of(user, *files, *named.values())
    copies = {file.url: _copy_in(folder, file.url) for file in files}
    targets = {path: file for file, path in zip(files, copies.values(), strict=True)}
    targets |= {_copy_in(folder, f"{place}/") / name: one for (place, name), one in named.items()}
    needed = sum(file.size for path, file in targets.items() if not path.exists())
    if needed:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
        if free < needed:
            raise ExportError(
                f"{cache}: expected {needed} free bytes for {', '.join(urls)}, found {free}; give "
                "another folder with --cache or $MLBATCH_CACHE"
            )
    for path, file in targets.items():
        if not path.exists():
            download(file, path)
    is_kept = False
    try:
        yield {url: str(copies[url]) for url in urls}
    except (Interrupted, KeyboardInterrupt):
        is_kept = True
        raise
    finally:
        if not is_kept:
            shutil.rmtree(folder, ignore_errors=True)


def digest_of(*values: object) -> str:
    """Values as the name of a folder."""
    return hashlib.sha256(repr(values).encode(errors="surrogateescape")).hexdigest()[:16]


def _copy_in(folder: Path, url: str) -> Path:
    """Return the path of a copy; copies are in one folder if and only if their files are."""
    parent, _, name = url.rpartition("/")
    return folder / digest_of(parent) / name


def download(file: RemoteFile, target: Path) -> None:
    """Copy a file here, in blocks; it appears complete or not at all, with its time of change.

    A copy that was interrupted continues.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.partial")
    with part.open("ab") as copy:
        at = copy.tell()
        while at < file.size:
            length = min(_BLOCK_BYTES, file.size - at)
            data = _request(file.url, partial(_range, at, length))
            copy.write(data)
            at += len(data)
    if at != file.size:
        part.unlink()
        raise RecordingError(
            f"{file.url}: expected {file.size} bytes, found {at}; it changed meanwhile: try again"
        )
    # A later copy is the same input to `convert --resume`.
    os.utime(part, ns=(file.changed_ns, file.changed_ns))
    part.replace(target)


@contextlib.contextmanager
def local_output(name: str) -> Iterator[Path]:
    """The path of an output; for a URL that of a copy, with report and table, removed afterwards.

    RecordingError without one.
    """
    if "://" not in name:
        yield Path(name)
        return
    url = name.rstrip("/")
    # Before a request: it names the package that is missing.
    _place(url)
    folder = url.rpartition("/")[0]
    files = listed(url)
    if not files:
        files = [head(url), *(one for one in listed(folder) if one.url.startswith(f"{url}."))]
    with tempfile.TemporaryDirectory(prefix="mlbatch-") as place:
        for file in files:
            download(file, Path(place, file.url.removeprefix(f"{folder}/")))
        yield Path(place, url.rpartition("/")[2])


def _range(at: int, length: int, obstore: Any, place: _Place) -> bytes:
    data = bytes(obstore.get_range(place.store, place.path, start=at, length=length))
    if len(data) != length:
        raise OSError(f"{len(data)} bytes instead of {length}")
    return data


def upload(path: Path, url: str) -> None:
    """Copy a file to a store, in parts; it appears complete or not at all."""
    _request(url, lambda obstore, place: obstore.put(place.store, place.path, path))


def read_text(url: str) -> str:
    """The text of a small file; "" without one."""
    with contextlib.suppress(RecordingError):
        data = _request(url, lambda obstore, place: obstore.get(place.store, place.path).bytes())
        return bytes(data).decode("utf-8", "replace")
    return ""


def remove(url: str) -> None:
    """Remove a file, if it exists."""
    with contextlib.suppress(RecordingError):
        _request(url, lambda obstore, place: obstore.delete(place.store, place.path))
