"""Per-sensor intake: the packets of a batch to accepted columns, by the rules of docs/batching.md.

`native/intake.c` reads packet after packet, rejects what is damaged, doubled or implausible, holds
a packet that steps until the next one, and counts sequence numbers. Where a clock steps it ends
with an event, which becomes a ClockJump here.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.batching.loss import PacketLoss
from mlbatch.errors import ClockJump
from mlbatch.lidar.headers import HeaderReader, Headers
from mlbatch.lidar.interface import FAULTS
from mlbatch.native import library as native
from mlbatch.types import ColumnHeaders
from mlbatch.units import NS_PER_S

# A packet whose stamps differ more than this from the newest one needs confirmation.
STEP_NS = NS_PER_S
STAMP_LIMIT_NS = 2**31 * NS_PER_S
# Stamps of no packet: before and after all others.
NEVER = -(2**62)
FOREVER = 2**62
# As in `native.h`.
DUPLICATE_REACH = 1024
_KEY_HEADS = 2048
_REASONS = (*FAULTS, "duplicate", "bad_stamp")
_BAD_STAMP = _REASONS.index("bad_stamp")
_RESET = 1


class Payloads(NamedTuple):
    """Packets (P,) `data[start[i] :]`, whose headers are to be read."""

    data: U8Array
    start: I64Array
    content_key: I64Array | None  # hashes of the contents, None: not known


class Arrival(NamedTuple):
    """Packets (P,) that may be of one sensor in one batch, in order of receive time."""

    position: I64Array  # index in the batch
    host_ns: I64Array  # receive time
    ring_index: I64Array  # of the packet's first column
    content: Payloads | Headers


class Accepted(NamedTuple):
    """Accepted packets (A,) of one sensor in a batch, with columns (A, C), in order of delivery.

    jump: of the sensor's clock, at which they end.
    """

    read: int  # packets of the sensor, good or not
    position: I64Array  # index in the batch of the packet with which each is delivered
    host_ns: I64Array  # receive time
    newest_ns: I64Array  # largest valid stamp, NEVER where none is valid
    lowest_ns: I64Array  # smallest valid stamp, FOREVER where none is valid
    columns: ColumnHeaders  # as they are batched
    ring_index: I64Array  # (A, C)
    invalid: int  # columns
    oldest: int  # smallest ring index
    behind_ns: int  # longest time of a column behind the newest stamp before it
    ahead_ns: int  # longest step of the newest stamp
    jump: ClockJump | None


class Watch(Protocol):
    """Observer of the stamps and receive times of accepted packets (`clocks.watch.ClockWatch`)."""

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Add packets (P,), in order of delivery."""
        ...


def extremes(headers: ColumnHeaders) -> tuple[I64Array, I64Array]:
    """Smallest and largest valid stamp of each packet; FOREVER and NEVER where none is valid."""
    stamp = headers.stamp_ns
    valid = headers.valid
    if valid.size and valid.all():
        return stamp.min(axis=1), stamp.max(axis=1)
    low = np.where(valid, stamp, FOREVER).min(axis=1, initial=FOREVER)
    high = np.where(valid, stamp, NEVER).max(axis=1, initial=NEVER)
    return low, high


class Intake:
    """Intake of one sensor; its state does not depend on how packets are grouped."""

    def __init__(
        self,
        name: str,
        column_offsets: I64Array,
        reader: HeaderReader | None = None,
        *,
        host_clock: bool = False,
        offset_ns: int = 0,
        modulus: int = 0,
        packet_ns: float = 0.0,
        has_receive_times: bool = True,
        finds_jumps: bool = False,
        takes_all: bool = False,
        watch: Watch | None = None,
    ) -> None:
        """Arguments of one sensor.

        column_offsets: (C,) ring index of a column after that of its packet; reader: None if
        headers are always given; host_clock: replace stamps by receive times; offset_ns: added to
        stamps; modulus, packet_ns: as in PacketLoss; has_receive_times: False where `--clock host`
        is refused; finds_jumps: end with a jump where stamps step forward and receive times do not;
        takes_all: look for neither duplicates nor steps; watch: observes all accepted packets.
        """
        self.name = name
        self.has_receive_times = has_receive_times
        self.loss = PacketLoss(modulus, packet_ns)
        columns = len(column_offsets)
        self._watch = watch
        self._reader = reader
        self._rejected = np.zeros(len(_REASONS), np.int64)
        self._struct = native.Intake(
            reader=None if reader is None else reader.struct,
            columns=columns,
            offsets=np.ascontiguousarray(column_offsets, np.int64),
            numbers=self.loss.numbers.struct,
            offset_ns=offset_ns,
            by_host=host_clock,
            finds_jumps=finds_jumps,
            takes_all=takes_all,
            newest_ns=NEVER,
            delivered_ns=NEVER,
            rejected=self._rejected,
            recent=np.zeros((DUPLICATE_REACH, 3), np.int64),
            heads=np.zeros(_KEY_HEADS, np.int64),
            held_stamp_ns=np.empty(columns, np.int64),
            held_encoder=np.empty(columns, np.int64),
            held_valid=np.empty(columns, np.bool_),
        )

    @property
    def reads(self) -> bool:
        """Whether it reads headers itself."""
        return self._reader is not None and self._reader.wrong_crc is None

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected packets by reason."""
        counts = zip(_REASONS, self._rejected.tolist(), strict=True)
        return {reason: count for reason, count in counts if count}

    @property
    def renumbered(self) -> int:
        """Duplicates by their number whose first timestamps are others."""
        return int(self._struct.renumbered)

    @property
    def held_host_ns(self) -> int | None:
        """Receive time of the packet that is held, if any."""
        return int(self._struct.held_host_ns) if self._struct.is_held else None

    @property
    def held_ring_index(self) -> int | None:
        """Ring index of the packet that is held, if any; its pixels must not be overwritten."""
        return int(self._struct.held_ring_index) if self._struct.is_held else None

    def finish(self) -> None:
        """End of input: reject the packet that is still held, since nothing can confirm it."""
        if self._struct.is_held:
            self._rejected[_BAD_STAMP] += 1
            self._struct.is_held = 0

    def accept(self, arrival: Arrival, owned: BoolArray) -> Accepted:
        """Accept the good packets of a batch; owned: (n,) which of it have a sensor, is set."""
        packets = len(arrival.position)
        shape = (packets + 1, self._struct.columns)
        position, host_ns, newest_ns, lowest_ns, sensor_ns = np.empty((5, shape[0]), np.int64)
        stamp_ns, encoder, ring_index = (np.empty(shape, np.int64) for _ in range(3))
        valid = np.empty(shape, np.bool_)
        out = native.Accepted(
            position=position,
            host_ns=host_ns,
            newest_ns=newest_ns,
            lowest_ns=lowest_ns,
            sensor_ns=sensor_ns,
            stamp_ns=stamp_ns,
            encoder=encoder,
            ring_index=ring_index,
            valid=valid,
        )
        given_packets = self._given(arrival, owned)
        if isinstance(arrival.content, Headers):
            given = arrival.content.columns
            stamp_ns[1:], encoder[1:], valid[1:] = given.stamp_ns, given.encoder, given.valid
        event = native.library().mlbatch_take(self._struct, given_packets, out)
        own = slice(out.packets)
        accepted = Accepted(
            out.read,
            position[own],
            host_ns[own],
            newest_ns[own],
            lowest_ns[own],
            ColumnHeaders(stamp_ns[own], encoder[own], valid[own]),
            ring_index[own],
            out.invalid,
            out.oldest,
            out.behind_ns,
            out.ahead_ns,
            self._jump(event, out) if event else None,
        )
        self._observe(accepted, sensor_ns[own])
        return accepted

    def _given(self, arrival: Arrival, owned: BoolArray) -> native.Arrival:
        """The struct of packets."""
        content = arrival.content
        arrays: dict[str, npt.NDArray[Any]] = {
            "position": arrival.position,
            "host_ns": arrival.host_ns,
            "ring_index": arrival.ring_index,
            "owned": owned,
        }
        if isinstance(content, Headers):
            arrays |= {"is_mine": content.is_mine, "faults": content.faults}
            arrays["given_keys"] = content.key
        elif self._reader is None:
            raise TypeError(f"sensor {self.name}: expected headers, or a reader")
        else:
            self._reader.refuse_outside(content.data, content.start)
            arrays |= {"data": content.data, "start": content.start}
            if content.content_key is not None:
                arrays["keys"] = content.content_key
        kept = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        if kept["owned"] is not owned:
            raise ValueError("expected a C-contiguous array")
        is_read = isinstance(content, Headers)
        return native.Arrival(packets=len(arrival.position), is_read=is_read, **kept)

    def _observe(self, accepted: Accepted, sensor_ns: I64Array) -> None:
        """Show accepted packets to the watch, and to what counts loss by gaps.

        sensor_ns: (A,) first stamps on the sensor's clock.
        """
        if not len(sensor_ns):
            return
        if self.loss.gaps is not None:
            columns = accepted.columns
            headers = ColumnHeaders(sensor_ns[:, None], columns.encoder, columns.valid)
            self.loss.gaps.add(headers, accepted.host_ns)
        if self._watch is not None and accepted.jump is None:
            measured = accepted.newest_ns > NEVER
            self._watch.add(accepted.newest_ns[measured], accepted.host_ns[measured])

    def _jump(self, event: int, out: native.Accepted) -> ClockJump:
        """The error for a step of the clock, at the first packet after it."""
        before_s = out.before_ns / NS_PER_S
        after_s = out.after_ns / NS_PER_S
        advice = remedies(self.has_receive_times)
        if event == _RESET:
            text = (
                f"clock reset within the recording: expected stamps of one continuous clock, "
                f"found a step back from {before_s:.6f} s to {after_s:.6f} s; {advice}"
            )
        else:
            passed_s = (out.after_host_ns - out.before_host_ns) / NS_PER_S
            text = (
                f"clock jump within the recording: expected stamps of one continuous clock, "
                f"found a step forward from {before_s:.6f} s to {after_s:.6f} s within "
                f"{passed_s:.6f} s at the capture host; {advice}"
            )
        return ClockJump(f"sensor {self.name}: {text}", int(out.after_host_ns))


def remedies(has_receive_times: bool) -> str:
    """Policy for a clock that jumps; has_receive_times: as in `Intake`."""
    return "use --on-jump split" + (", or --clock host" if has_receive_times else "")
