"""Values passed between the packages: packets, columns, scans, messages."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array, U32Array
from mlbatch.units import NS_PER_MS

if TYPE_CHECKING:
    from mlbatch.native.arena import PacketArena

# Models of decoded clouds, by the number of their source in packets of points; their rate is
# unknown.
CLOUDS = ("PointCloud2", "CustomMsg")


class Stream(NamedTuple):
    """Origin of packets: a (source IP, destination port) of a capture, or a topic of a bag.

    Source ports are ephemeral and no part of it. frame_id, lidar_id: only where a topic has decoded
    clouds of several lidars.
    """

    source_ip: str = ""
    port: int = 0  # destination
    topic: str = ""
    frame_id: str = ""
    lidar_id: int | None = None

    def __str__(self) -> str:
        parts = [f"frame_id {self.frame_id}"] if self.frame_id else []
        parts += [] if self.lidar_id is None else [f"lidar_id {self.lidar_id}"]
        part = f" ({', '.join(parts)})" if parts else ""
        return f"{self.topic}{part}" if self.topic else f"{self.source_ip} > port {self.port}"

    @property
    def names(self) -> frozenset[str]:
        """Names that `--only` and `--ignore` accept for it."""
        if self.topic:
            return frozenset({str(self), self.topic})
        address = f"[{self.source_ip}]" if ":" in self.source_ip else self.source_ip
        return frozenset({str(self), f"{address}:{self.port}"})


class Topic(NamedTuple):
    """A topic of a bag as its recording describes it."""

    name: str
    type: str  # package/Type, without the /msg/ of ROS 2
    encoding: str  # `cdr` or `ros1`
    definition: str = ""  # of the type, as stored in the recording; "": none
    format: str = ""  # of the definition: `ros1msg`, `ros2msg` or `ros2idl`
    qos: str = ""  # QoS profiles, as stored in the recording
    latched: bool = False  # ROS 1 latching, or transient local durability


class Message(NamedTuple):
    """A message without lidar packets, as stored.

    data: a view that is valid until the next batch where the topic is in `Recording.lend`.
    """

    topic: Topic
    host_ns: int  # log time
    data: bytes | memoryview


# All further streams are this one: addresses may be invented without end.
OTHER_STREAMS = Stream(topic="(other streams)")
MOST_STREAMS = 1 << 16


@dataclass(slots=True)
class StreamTable:
    """Numbers the streams of a session; all its readers share one table.

    After MOST_STREAMS all streams have the number of OTHER_STREAMS.
    """

    streams: list[Stream] = field(default_factory=list)
    # Streams whose packets have no receive time of their own: `host_ns` is the log time of a
    # message with many packets, so that `--clock host` cannot be used.
    untimed: set[int] = field(default_factory=set)
    # By stream: most packets in a message, and longest time of a message of decoded points, ns.
    most_packets: dict[int, int] = field(default_factory=dict)
    message_ns: dict[int, int] = field(default_factory=dict)
    _numbers: dict[Stream, int] = field(default_factory=dict)

    def number(self, stream: Stream) -> int:
        """Number of `stream`, given at its first packet."""
        number = self._numbers.get(stream)
        if number is None:
            if self.is_full and stream != OTHER_STREAMS:
                return self.number(OTHER_STREAMS)
            number = len(self.streams)
            self._numbers[stream] = number
            self.streams.append(stream)
        return number

    @property
    def is_full(self) -> bool:
        """True if further streams are OTHER_STREAMS."""
        return len(self.streams) >= MOST_STREAMS


@dataclass(slots=True)
class PacketBatch:
    """UDP payloads in receive order; valid only until the next batch, since readers reuse `data`.

    Payload i is `data[start[i] : start[i] + size[i]]`.
    """

    data: U8Array  # (bytes,)
    start: I64Array  # (n,)
    size: I64Array  # (n,)
    stream: I64Array  # (n,) numbers in a `StreamTable`
    host_ns: I64Array  # (n,) receive time at the capture host, of the completing fragment
    messages: tuple[Message, ...] = ()  # of the topics in `Recording.keep`, in file order
    place: int | None = None  # of `data[0]` in the `PacketArena` of the pass; None: elsewhere
    # (n,) hashes of the contents, as `lidar.headers.content_keys`; None: not known.
    content_key: I64Array | None = None

    def __len__(self) -> int:
        return len(self.start)

    def take(self, index: I64Array | slice) -> PacketBatch:
        """The packets at `index`, over the same bytes, without messages."""
        return PacketBatch(
            self.data,
            self.start[index],
            self.size[index],
            self.stream[index],
            self.host_ns[index],
            place=self.place,
            content_key=None if self.content_key is None else self.content_key[index],
        )


@dataclass(slots=True)
class CaptureCounts:
    """Frames of a reader: frames = datagrams + sum(skipped)."""

    frames: int = 0
    datagrams: int = 0
    skipped: dict[str, int] = field(default_factory=dict)  # by reason

    def skip(self, reason: str, count: int = 1) -> None:
        """Count frames without a datagram; reasons: `ledger.CAPTURE_REASONS`.

        Less than 0: frames of a datagram that another capture completed.
        """
        total = self.skipped.pop(reason, 0) + count
        if total:
            self.skipped[reason] = total


# A capture may begin so much before the end of the one that it continues: receive times step back
# where several queues are captured.
MAX_OVERLAP_NS = 10 * NS_PER_MS


class CutOff(str):
    """A note of a recording that ends early: its end is missing, or was not read."""

    __slots__ = ()


@dataclass(slots=True)
class Recording:
    """An opened recording; each container derives its own `packets`."""

    path: Path
    container: str  # name of the format
    size_bytes: int  # of the files on disk
    # All topics of a bag.
    topics: tuple[Topic, ...] = field(default=(), kw_only=True)
    # Topics whose messages the batches include; set before `packets` is called.
    keep: frozenset[str] = field(default=frozenset(), kw_only=True)
    # Topics in `keep` whose messages may be views of the batch; set before `packets` is called.
    lend: frozenset[str] = field(default=frozenset(), kw_only=True)
    # Frames of the current pass.
    counts: CaptureCounts = field(default_factory=CaptureCounts, kw_only=True)
    # Damage of the recording, one line each; `CutOff` where nothing after it was read.
    notes: list[str] = field(default_factory=list, kw_only=True)
    # Newest log time by the container's own index; None: it has none.
    last_ns: int | None = field(default=None, kw_only=True)
    # Part of `size_bytes` that the current pass has read.
    position_bytes: int = field(default=0, kw_only=True)

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, in file order; each call is a new pass.

        A pass resets counts, notes and position. Closing the generator closes the file.
        """
        raise NotImplementedError

    def last_packets(self, streams: StreamTable) -> PacketBatch | None:
        """Return packets at the end, without reading those before; None where that is impossible.

        streams: numbers their streams. The batch stays valid.
        """
        return None

    @property
    def fragments_begin_ns(self) -> int | None:
        """Receive time of the first frame of the newest pass, if it left datagrams open."""
        return None

    def follow(self, earlier: Recording) -> None:
        """Begin the next pass with the fragments that `earlier` left open, if it continues that.

        earlier: was read to its end; this one: at least its first packets were read.
        """

    def use_arena(self, arena: PacketArena) -> bool:
        """Read the next pass into an arena; False for containers that cannot."""
        return False


class WrappedRecording(Recording):
    """A recording that changes the packets of another one.

    Only `keep` and `lend` are its own; attributes that are not set here are looked up in `inner`.
    """

    __slots__ = ("inner",)

    def __init__(self, inner: Recording) -> None:
        self.inner = inner
        self.keep = frozenset()
        self.lend = frozenset()

    def __getattr__(self, name: str) -> object:
        """Called for slots without a value."""
        return getattr(self.inner, name)

    @property
    def fragments_begin_ns(self) -> int | None:
        """Pass the time on."""
        return self.inner.fragments_begin_ns

    def follow(self, earlier: Recording) -> None:
        """Pass on what both wrap."""
        self.inner.follow(earlier.inner if isinstance(earlier, WrappedRecording) else earlier)

    def use_arena(self, arena: PacketArena) -> bool:
        """Not passed on, since packets change; see `Recording`."""
        return False


@dataclass(slots=True)
class Columns:
    """Columns of one sensor: small fixed records; their pixels stay raw in the sensor's ring."""

    stamp_ns: I64Array  # (n,) common clock
    ring_index: I64Array  # (n,) row of the sensor's `PacketRing`
    encoder: I64Array  # (n,) index into the angle table of the beams, or rotor word

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: I64Array | BoolArray | slice) -> Columns:
        """The columns at `index`."""
        return Columns(self.stamp_ns[index], self.ring_index[index], self.encoder[index])


class ColumnFigures(NamedTuple):
    """Columns of one sensor in one window; coverage and overlap as in `Scan`."""

    columns: int
    max_gap_ns: int  # between two of them
    coverage: float
    overlap: float
    # Timestamps; 0 without a column.
    first_ns: int
    last_ns: int


NO_COLUMNS = ColumnFigures(0, 0, 0.0, 0.0, 0, 0)
# Of all sensors in one window.
WindowFigures: TypeAlias = Sequence[ColumnFigures]


@dataclass(slots=True)
class WindowColumns:
    """Columns of all sensors by stamp, then sensor, then order of delivery; arrays (n,) int64."""

    stamp_ns: I64Array  # common clock
    sensor: I64Array  # index of the column's sensor
    ring_index: I64Array  # as in `Columns`
    encoder: I64Array  # as in `Columns`
    # (n, 3, 4) float32, m: what moves the points of a column, body frame; None: nothing.
    moves: F32Array | None = None

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: slice | I64Array) -> WindowColumns:
        """Return the columns at `index`."""
        return WindowColumns(
            self.stamp_ns[index],
            self.sensor[index],
            self.ring_index[index],
            self.encoder[index],
            None if self.moves is None else self.moves[index],
        )


@dataclass(slots=True)
class Window:
    """Columns of all sensors in one window or slice, sorted by stamp, sensor, order of delivery."""

    index: int  # number of the window from t_init, -1 for the one before (the head)
    slice: int  # within the window
    start_ns: int  # inclusive
    end_ns: int  # exclusive
    complete: bool  # every sensor covers the window in time
    ready_host_ns: int  # receive time of the packet that closed it
    columns: WindowColumns
    figures: WindowFigures = ()  # by sensor
    edge_gap_ns: tuple[int, ...] = ()  # by sensor, widest gap at either bound
    # By sensor: see `FillMeter` in `batching/fill.py`.
    fill: F32Array = field(default_factory=lambda: np.zeros(0, np.float32))
    is_partial: bool = False  # the head or the tail
    world_from_body: F64Array | None = None  # as of `Scan`


@dataclass(slots=True)
class ColumnHeaders:
    """Headers of the C columns of P packets, read before any pixel is decoded."""

    stamp_ns: I64Array  # (P, C) sensor clock, the column's earliest nominal firing
    encoder: I64Array  # (P, C) rotor position, as in `Columns`
    valid: BoolArray  # (P, C) True where the sensor reports the column as measured


@dataclass(frozen=True, slots=True)
class SensorInfo:
    """A sensor as outputs describe it."""

    name: str
    model: str
    channels: int
    returns: int
    ring_base: int  # first ring number of its channels
    body_from_sensor: F64Array  # (4, 4) m
    has_reflectivity: bool = False  # calibrated, in addition to intensity
    # (4, 4) m; None: it sends no IMU data.
    sensor_from_imu: F64Array | None = field(default=None, compare=False)


def instant_ns(word: str, start_ns: int, end_ns: int) -> int:
    """Return an instant of a window [start_ns, end_ns) by a word of INSTANTS."""
    return {"start": start_ns, "middle": (start_ns + end_ns) // 2, "end": end_ns}[word]


# Options of `convert` that change what a scan is, or where its points are.
VARIANTS = ("batching", "batching_times", "stamp", "deskew", "deskew_to")


class RunInfo(NamedTuple):
    """Properties that all scans of a run share."""

    sensors: tuple[SensorInfo, ...]  # in the order of `lidar_id`
    frame_id: str  # of the body
    rate_hz: str  # exact rate as text: "10", "10/3"
    timescale: str  # utc, tai, uptime or unknown
    slices: int = 1  # a window
    layout: str = "dense"  # or organized
    sort: str = "columns"  # order of the points of a dense scan: by their columns, or `points`
    # Static frames of the recording that forwarded messages may name: name, (4, 4) body_from_frame.
    frames: tuple[tuple[str, F64Array], ...] = ()
    # Options of VARIANTS, where they differ from the default: name and value, as in outputs.
    variants: tuple[tuple[str, str], ...] = ()
    t_init_ns: int | None = None  # start of the window of index 0; None: not known

    def variant(self, name: str, default: str) -> str:
        """Value of one of `variants`."""
        return dict(self.variants).get(name, default)


class RecordPiece(NamedTuple):
    """A piece of a packed point record: bytes copied from a point, or a value computed from it.

    kind: a word of RECORD_KINDS; source: first byte of a copy in the kind's array; bytes: length.
    """

    kind: str
    offset: int  # bytes, in the record
    source: int
    bytes: int


# Arrays to copy from (`decode/scan_buffer.py`): point, label, reflectivity. Computed: time in s as
# float32 (toward zero) and as float64, ring, range in mm, timestamp in s, ring and sensor as
# float32; a whole record of LAS, of dense scans.
RECORD_KINDS = (
    "point",
    "label",
    "reflectivity",
    "seconds_f4",
    "seconds_f8",
    "ring_i4",
    "range_mm_u4",
    "stamp_f8",
    "ring_f4",
    "lidar_f4",
    "las",
)


class RecordLayout(NamedTuple):
    """Point records that are packed while points are decoded; bytes between pieces are zero."""

    step: int  # bytes of a record
    pieces: tuple[RecordPiece, ...]
    # Of runs in which no sensor has reflectivities; None: the same, with zeros.
    plain: RecordLayout | None = None
    # By timescale and start of a scan, ns: where timestamps in s begin, s after the timescale does.
    # None: where it does.
    epoch_s: Callable[[str, int], int] | None = None


class PackedTotals(NamedTuple):
    """Totals over the points of a scan, for a header."""

    low_m: tuple[float, ...]  # x, y, z; above `high_m` without points
    high_m: tuple[float, ...]
    second_returns: int  # points that are the farther of two returns


class PackedPoints(NamedTuple):
    """The points of a scan as records of the output.

    buffer: bytes; records begin at `begin` and end at `end`; PACKED_ROOM bytes before them and one
    behind them are free, for what a message adds. shape: (p,), or (slots, n) when organized.
    """

    buffer: U8Array
    begin: int
    end: int
    shape: tuple[int, ...]
    totals: PackedTotals | None = None  # of LAS


PACKED_ROOM = 4096

# Optional arrays of a scan: those that the output cannot store are not made.
EXTRAS = frozenset({"reflectivity", "range_m", "column"})
# Listed with EXTRAS by outputs whose intensity has 8 bits: points outside 0 to 255 are counted.
BYTE_INTENSITY = "byte_intensity"
# Listed with EXTRAS by outputs that store IMU samples.
IMU = "imu"
# Listed with EXTRAS by outputs that store recorded messages: the encodings they can store.
MESSAGE_ENCODINGS = frozenset({"cdr", "ros1"})


@dataclass(slots=True)
class Scan:
    """All columns of one window of the common clock, sorted by timestamp; fields as in the npz.

    n columns. Dense: p points, only valid returns, never NaN. Organized: arrays of points are
    (n, slots[, 3]), NaN where empty. Arrays of EXTRAS are None where the output cannot store them.
    """

    info: RunInfo
    index: int  # of the window, from t_init
    slice: int  # within the window
    start_ns: int
    end_ns: int
    complete: bool  # every sensor covers the window in time
    ready_host_ns: int  # receive time of the packet that closed the window
    xyz: F32Array  # (p, 3) m, body frame
    intensity: F32Array  # (p,)
    reflectivity: U16Array | None  # (p,)
    range_m: F32Array | None  # (p,)
    time_ns: U32Array  # (p,) after `start_ns`
    ring: U16Array  # (p,)
    return_type: U8Array  # (p,)
    lidar_id: U8Array  # (p,)
    column: U32Array | None  # (p,) index of the point's column; None when organized
    column_stamp_ns: I64Array  # (n,)
    column_lidar_id: U8Array  # (n,)
    points: int
    columns_per_sensor: tuple[int, ...]
    points_per_sensor: tuple[int, ...]
    # By sensor: widest time without a column, from the last one before the window up to its end.
    max_gap_ns: tuple[int, ...]
    coverage: tuple[float, ...] = ()  # by sensor, share of a revolution passed at least once
    overlap: tuple[float, ...] = ()  # by sensor, share of a revolution passed more than once
    # (s,) by sensor, columns present / columns expected, 0 to 1; NaN: unknown.
    fill: F32Array = field(default_factory=lambda: np.zeros(0, np.float32))
    is_partial: bool = False  # the head or the tail
    # (4, 4) m: pose at the instant that points were moved to by poses; None: they were not.
    world_from_body: F64Array | None = None
    # If a writer asked for records (`WriterModule`) and the engine packs them: instead of the
    # arrays of points, which are empty then.
    packed: PackedPoints | None = None

    @property
    def slices(self) -> int:
        """Slices a window is cut into."""
        return self.info.slices


@dataclass(slots=True)
class ImuSamples:
    """Samples of one sensor's IMU, in its IMU frame."""

    sensor: int  # index in `RunInfo.sensors`
    stamp_ns: I64Array  # (n,) the lidar's clock
    acceleration: F64Array  # (n, 3) m/s2
    angular_velocity: F64Array  # (n, 3) rad/s


@dataclass(frozen=True, slots=True)
class Summary:
    """Results of a run that a writer may store at its end."""

    t_init_ns: int | None  # None: no window was reached
    report_json: str  # report.json without timings and paths
    scans_csv: str  # text of scans.csv
    # Totals of fill, as texts by name; docs/formats.md#mcap.
    fill: dict[str, str] = field(default_factory=dict)
