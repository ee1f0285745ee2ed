"""What flows through mlbatch: packets in batches, columns that wait, scans that leave."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array, U32Array


@dataclass(frozen=True, slots=True)
class Stream:
    """Where packets come from: a (source IP, destination port) of a capture, or a topic of a bag.

    Source ports are left out on purpose: they are ephemeral.
    """

    source_ip: str = ""
    port: int = 0
    topic: str = ""

    def __str__(self) -> str:
        return self.topic or f"{self.source_ip} > port {self.port}"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag as its recording describes it.

    type: package/Type, without the /msg/ of ROS 2; encoding: `cdr` or `ros1`; definition: text
    stored in the recording ("" if none) in the format `ros1msg`, `ros2msg` or `ros2idl`; qos: the
    recorder's text; latched: ROS 1 latching, or transient local durability.
    """

    name: str
    type: str
    encoding: str
    definition: str = ""
    format: str = ""
    qos: str = ""
    latched: bool = False


@dataclass(frozen=True, slots=True)
class Message:
    """A message that holds no lidar packets, as it is stored; host_ns: log time."""

    topic: Topic
    host_ns: int
    data: bytes


@dataclass(slots=True)
class StreamTable:
    """Numbers the streams of a session; all its readers share one table.

    untimed: streams whose packets have no arrival time of their own (`host_ns` is then the log
    time of the message that holds many of them), so that `--clock host` cannot be used.
    """

    streams: list[Stream] = field(default_factory=list)
    untimed: set[int] = field(default_factory=set)
    _numbers: dict[Stream, int] = field(default_factory=dict)

    def number(self, stream: Stream) -> int:
        """Number of `stream`, given at its first packet."""
        found = self._numbers.get(stream)
        if found is None:
            found = self._numbers[stream] = len(self.streams)
            self.streams.append(stream)
        return found


@dataclass(slots=True)
class PacketBatch:
    """UDP payloads in arrival order; valid only until the next batch, since readers reuse `data`.

    Payload i is `data[start[i] : start[i] + size[i]]`.
    data: (bytes,) uint8; start, size: (n,) int64; stream: (n,) int64, numbers of a `StreamTable`;
    host_ns: (n,) int64, time of arrival at the recorder (of the completing fragment); messages:
    those of the topics that the recording was asked to `keep`, in file order, whose time has come
    with this batch.
    """

    data: U8Array
    start: I64Array
    size: I64Array
    stream: I64Array
    host_ns: I64Array
    messages: tuple[Message, ...] = ()

    def __len__(self) -> int:
        return len(self.start)

    def take(self, index: I64Array | slice) -> PacketBatch:
        """The packets at `index`, over the same bytes, without messages."""
        return PacketBatch(
            self.data, self.start[index], self.size[index], self.stream[index], self.host_ns[index]
        )


@dataclass(slots=True)
class CaptureCounts:
    """The ledger of a reader: frames = datagrams + sum(skipped)."""

    frames: int = 0
    datagrams: int = 0
    skipped: dict[str, int] = field(default_factory=dict)

    def skip(self, reason: str, count: int = 1) -> None:
        """Count `count` frames that gave no datagram; reasons: `ledger.CAPTURE_REASONS`."""
        if count:
            self.skipped[reason] = self.skipped.get(reason, 0) + count


@dataclass(slots=True)
class Recording:
    """An opened recording; each container derives its own `packets`.

    container: name of the format; size_bytes: of the files on disk; topics: all topics of a bag;
    keep: names of topics whose messages the batches include (set before `packets` is called);
    counts: frames of the current pass; notes: what is wrong with the recording, one line each;
    position_bytes: how much of `size_bytes` the current pass has read.
    """

    path: Path
    container: str
    size_bytes: int
    topics: tuple[Topic, ...] = field(default=(), kw_only=True)
    keep: frozenset[str] = field(default=frozenset(), kw_only=True)
    counts: CaptureCounts = field(default_factory=CaptureCounts, kw_only=True)
    notes: list[str] = field(default_factory=list, kw_only=True)
    position_bytes: int = field(default=0, kw_only=True)

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, in file order; each call is a new pass.

        A pass resets counts, notes and position. Closing the generator closes the file.
        """
        raise NotImplementedError

    def use_engine(self, engine: str) -> None:
        """Read by `numpy` or `numba`; ignored by containers that have one implementation."""


class WrappedRecording(Recording):
    """A recording that changes the packets of another one; all else is that of the inner one.

    Only `keep` is its own. Attributes that are not set here are looked up in `inner`.
    """

    __slots__ = ("inner",)

    def __init__(self, inner: Recording) -> None:
        self.inner = inner
        self.keep = frozenset()

    def __getattr__(self, name: str) -> object:
        """Called for slots without a value."""
        return getattr(self.inner, name)

    def use_engine(self, engine: str) -> None:
        """Pass the engine on."""
        self.inner.use_engine(engine)


@dataclass(slots=True)
class Columns:
    """Columns of one sensor: small fixed records; their pixels stay raw in the sensor's ring.

    stamp_ns: (n,) int64, common clock; place: (n,) int64, row of the sensor's `PacketRing`;
    encoder: (n,) int64, rotor position (index into the sensor's angle table).
    """

    stamp_ns: I64Array
    place: I64Array
    encoder: I64Array

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: I64Array | BoolArray | slice) -> Columns:
        """The columns at `index`."""
        return Columns(self.stamp_ns[index], self.place[index], self.encoder[index])


@dataclass(slots=True)
class Heads:
    """What the columns of P packets say of themselves, before any pixel is decoded.

    stamp_ns: (P, C) int64, sensor clock, the column's earliest nominal firing;
    encoder: (P, C) int64; valid: (P, C) bool, the sensor's own word that the column was measured.
    """

    stamp_ns: I64Array
    encoder: I64Array
    valid: BoolArray


@dataclass(slots=True)
class Pixels:
    """Readings of n columns of one return: (n, channels) each.

    range_m: float32, 0 where nothing came back; intensity: float32, sensor units;
    reflectivity: uint16, or None where the sensor has none.
    """

    range_m: F32Array
    intensity: F32Array
    reflectivity: U16Array | None


@dataclass(frozen=True, slots=True)
class SensorInfo:
    """What outputs say of a sensor; `body_from_sensor` is (4, 4) float64, metres."""

    name: str
    model: str
    channels: int
    returns: int
    ring_base: int
    body_from_sensor: F64Array


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What is the same for all scans of a run.

    rate_hz: the exact rate as text ("10", "10/3"); timescale: utc, tai, uptime or unknown;
    layout: dense or organized; sensors in the order of `lidar_id`.
    """

    sensors: tuple[SensorInfo, ...]
    frame_id: str
    rate_hz: str
    timescale: str
    slices: int = 1
    layout: str = "dense"


# Arrays of a scan that not every output has a place for; only those that are asked for are made.
EXTRAS = frozenset({"reflectivity", "range_m", "column"})
# Said together with EXTRAS by outputs that also hold IMU samples.
IMU = "imu"
# Likewise by outputs that take messages of a recording as they are: the encodings they have a
# place for.
MESSAGE_ENCODINGS = frozenset({"cdr", "ros1"})


@dataclass(slots=True)
class Scan:
    """All columns of one window of the common clock, sorted by stamp; fields as in the npz.

    Dense: p points, only valid returns, never NaN. Organized: (n, slots) each, NaN where empty.
    xyz: (p, 3) float32, m, body frame; intensity, range_m: (p,) float32; reflectivity: (p,) uint16
    or None; time_ns: (p,) uint32 after `start_ns`; ring: (p,) uint16; return_type, lidar_id:
    (p,) uint8; column: (p,) uint32, or None when organized; column_stamp_ns: (n,) int64;
    column_lidar_id: (n,) uint8. The arrays of EXTRAS are None where nobody asked for them.
    `ready_host_ns` is the arrival of the packet that closed the window; `max_gap_ns[s]` the widest
    step between columns of sensor s (0: fewer than two); `coverage[s]`, `overlap[s]`: shares of a
    turn that its rotor passed at least once, and more than once.
    """

    info: RunInfo
    index: int
    slice: int
    start_ns: int
    end_ns: int
    complete: bool
    ready_host_ns: int
    xyz: F32Array
    intensity: F32Array
    reflectivity: U16Array | None
    range_m: F32Array | None
    time_ns: U32Array
    ring: U16Array
    return_type: U8Array
    lidar_id: U8Array
    column: U32Array | None
    column_stamp_ns: I64Array
    column_lidar_id: U8Array
    points: int
    columns_per_sensor: tuple[int, ...]
    max_gap_ns: tuple[int, ...]
    coverage: tuple[float, ...] = ()
    overlap: tuple[float, ...] = ()

    @property
    def slices(self) -> int:
        """Slices a window is cut into."""
        return self.info.slices


@dataclass(slots=True)
class ImuSamples:
    """Samples of one sensor's IMU, in its IMU frame.

    sensor: index in `RunInfo.sensors`; stamp_ns: (n,) int64, the lidar's clock;
    acceleration: (n, 3) float64, m/s2; angular_velocity: (n, 3) float64, rad/s.
    """

    sensor: int
    stamp_ns: I64Array
    acceleration: F64Array
    angular_velocity: F64Array


@dataclass(frozen=True, slots=True)
class Summary:
    """What a writer may add at the end of a run.

    t_init_ns: None when the run never started; report_json: report.json without timings and paths;
    scans_csv: text of scans.csv.
    """

    t_init_ns: int | None
    report_json: str
    scans_csv: str
