"""Kernels as native functions: compiled once, kept in the user's cache folder, loaded in 10 ms.

Source: the XDG base directory specification, version 0.8, for the place. An entry is named by all
that its code depends on, and carries a checksum; whatever is wrong with it, it is compiled anew.
Calls go through ctypes, which lets other threads run meanwhile.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import threading
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from mlbatch.arrays import I64Array

if TYPE_CHECKING:
    import llvmlite.binding as llvm

Constant: TypeAlias = str | int

_MAGIC = b"mlbatch kernel 1\n"
_DIGEST_BYTES = 32
_OPTIMISED = 3
_OTHERS_MAY_WRITE = 0o022
# What compilers put in by themselves, here and there: the last ones on macOS.
MEMORY_FUNCTIONS = (
    *("memcpy", "memmove", "memset"),
    *("bzero", "__bzero", "memset_pattern4", "memset_pattern8", "memset_pattern16"),
)
# Of some tens of kilobytes each; other versions of the package leave theirs behind.
_MOST_ENTRIES = 200


class Kernel:
    """A compiled function of one argument: a frame of addresses and numbers.

    address: where its code lies, for other kernels.
    """

    def __init__(self, address: int, owner: llvm.ExecutionEngine) -> None:
        # numba's calling convention: places of the result and of an exception, then the arguments.
        kind = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * 3)
        self._call = kind(address)
        self.address = address
        # The code lives as long as what loaded it.
        self._owner = owner

    def __call__(self, frame: I64Array) -> int:
        """Run; frame: (k,) int64, what the kernel's source says. No other thread is held up."""
        result, raised = ctypes.c_int64(), ctypes.c_void_p()
        self._call(ctypes.byref(result), ctypes.byref(raised), frame.ctypes.data)
        return result.value


_loaded: dict[tuple[str, tuple[Constant, ...]], Kernel] = {}
_lock = threading.Lock()


def load(source: str, *constants: Constant) -> Kernel:
    """The kernel that `build(*constants)` of the module `source` makes; ready in this process.

    ImportError where numba is needed and cannot be loaded.
    """
    key = (source, constants)
    with _lock:
        if key not in _loaded:
            _loaded[key] = _ready(source, constants)
        return _loaded[key]


def is_kept(source: str, *constants: Constant) -> bool:
    """Whether `load` would find the kernel compiled."""
    folder = cache_folder()
    return folder is not None and _read(folder / _name(source, constants)) is not None


def cache_folder() -> Path | None:
    """Where compiled kernels are kept; None where that is no place for code to be run."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = (Path(home) if os.path.isabs(home) else Path.home() / ".cache") / "mlbatch"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.stat()
    except (OSError, RuntimeError):
        return None
    # Code that others could have put there is not run.
    if hasattr(os, "geteuid") and (
        state.st_uid != os.geteuid() or state.st_mode & _OTHERS_MAY_WRITE
    ):
        return None
    return folder


@lru_cache(maxsize=1)
def machine() -> llvm.TargetMachine:
    """The compiler's idea of this computer."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    # Without numba, nothing else tells where these are.
    library = ctypes.CDLL(None)
    for name in MEMORY_FUNCTIONS:
        if hasattr(library, name):
            llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)
    target = llvm.Target.from_default_triple()
    cpu, features = _processor()
    return target.create_target_machine(cpu=cpu, features=features, opt=_OPTIMISED, jit=True)


def has_features(*names: str) -> bool:
    """Whether the CPU has all of these, by the names that llvm gives them."""
    # Those that numba is told to compile for may have less.
    if any(key.startswith("NUMBA_CPU") or key == "NUMBA_ENABLE_AVX" for key in os.environ):
        return False
    return {f"+{name}" for name in names} <= set(_processor()[1].split(","))


@lru_cache(maxsize=1)
def _processor() -> tuple[str, str]:
    """Name and abilities of the CPU, as llvm knows them."""
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features().flatten()
    # Loads of lanes from many places are slower than single loads on many CPUs that have them.
    slow = ",+prefer-no-gather" if "+avx2" in features.split(",") else ""
    return llvm.get_host_cpu_name(), features + slow


@lru_cache(maxsize=1)
def _machine_identity() -> bytes:
    settings = [f"{key}={os.environ[key]}" for key in sorted(os.environ) if "NUMBA_" in key]
    words = "\n".join([*_processor(), *settings]).encode()
    return b"\0".join([words, *(_version(package) for package in ("numba", "llvmlite"))])


def _version(package: str) -> bytes:
    """The file in which a package says its version: a millisecond, and without loading it."""
    found = importlib.util.find_spec(package)
    if found is not None and found.origin is not None:
        path = Path(found.origin).with_name("_version.py")
        if path.is_file():
            return path.read_bytes()
    # Slow to import.
    from importlib.metadata import version

    return version(package).encode()


@lru_cache(maxsize=8)
def _text(source: str) -> bytes:
    """The source of a kernel, and of all that kernels are made of."""
    found = importlib.util.find_spec(source)
    own = [] if found is None or found.origin is None else [Path(found.origin).read_bytes()]
    return b"\0".join([*own, *_shared_texts()])


@lru_cache(maxsize=1)
def _shared_texts() -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))


def _name(source: str, constants: tuple[Constant, ...]) -> str:
    parts = [_machine_identity(), _text(source), repr((source, constants)).encode()]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:40] + ".kernel"


def _ready(source: str, constants: tuple[Constant, ...]) -> Kernel:
    folder = cache_folder()
    path = None if folder is None else folder / _name(source, constants)
    entry = None if path is None else _read(path)
    if entry is None:
        from mlbatch.decode.kernels._compile import compiled

        entry = compiled(source, constants)
        if path is not None:
            _keep(path, *entry)
    return _linked(*entry)


def _linked(symbol: str, code: bytes) -> Kernel:
    """Object code, placed in memory."""
    import llvmlite.binding as llvm

    # An engine takes over the machine that it is made with.
    machine()
    cpu, features = _processor()
    own = llvm.Target.from_default_triple().create_target_machine(cpu=cpu, features=features)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), own)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Kernel(engine.get_function_address(symbol), engine)


def _read(path: Path) -> tuple[str, bytes] | None:
    """Symbol and code of an entry; None where there is none, or a damaged one."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    head, body = content[: len(_MAGIC)], content[len(_MAGIC) + _DIGEST_BYTES :]
    if head != _MAGIC or content[len(_MAGIC) :][:_DIGEST_BYTES] != hashlib.sha256(body).digest():
        return None
    symbol, _, code = body.partition(b"\0")
    return symbol.decode(), code


def _keep(path: Path, symbol: str, code: bytes) -> None:
    """Write an entry at once or not at all; without room for it, it is compiled again next time."""
    # Not needed by those who find an entry.
    import tempfile

    body = symbol.encode() + b"\0" + code
    partial = None
    try:
        handle, partial = tempfile.mkstemp(dir=path.parent, suffix=".partial")
        with os.fdopen(handle, "wb") as file:
            file.write(_MAGIC + hashlib.sha256(body).digest() + body)
        os.replace(partial, path)
        _prune(path.parent)
    except OSError:
        if partial is not None:
            Path(partial).unlink(missing_ok=True)


def _prune(folder: Path) -> None:
    """Remove the oldest entries beyond a number, and what killed processes left."""
    entries = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in entries[_MOST_ENTRIES:]:
        if path.suffix in (".kernel", ".partial"):
            path.unlink(missing_ok=True)
