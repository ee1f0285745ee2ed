"""Headers of packets, literally: what the tables of `lidar/headers.py` say, in plain Python.

One packet at a time, by the standard library alone: dates by `datetime`, medians by `statistics`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from math import floor
from statistics import median_low
from typing import Any

from mlbatch.lidar.headers import (
    DatedGroups,
    EvenColumns,
    HeaderTable,
    PacedBlocks,
    StampedColumns,
    TimedRows,
)

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_NS = 10**9
GOOD, BAD_HEADER = 0, 2


def _of(table: HeaderTable, name: str) -> Any:
    """An array of a table, as the vendor gave it."""
    return vars(table).get(name)


@dataclass
class Seen:
    """A packet; columns: stamp, encoder and validity of each; key None: the content's hash."""

    is_mine: bool
    fault: int
    key: int | None
    columns: list[tuple[int, int, bool]]


def read(table: HeaderTable, packet: bytes, host_ns: int) -> Seen:
    """Read a packet of a sensor with these headers, received at host_ns."""
    if isinstance(table, StampedColumns):
        return _stamped(table, packet)
    if isinstance(table, PacedBlocks):
        return _paced(table, packet, host_ns)
    if isinstance(table, DatedGroups):
        return _dated(table, packet)
    if isinstance(table, TimedRows):
        return _timed(table, packet)
    assert isinstance(table, EvenColumns)
    return _even(table, packet)


def rotor_word(turns: float, turns_per_s: float, row: int) -> int:
    """32 bits of a revolution, 24 of the speed in 2^-48 revolutions a ns, then the table."""
    most = 2**23 - 1
    angle = round((turns - floor(turns)) * 2.0**32) % 2**32
    speed = min(max(round(turns_per_s * (2.0**48 * 1e-9)), -most), most) % 2**24
    return angle + speed * 2**32 + row * 2**56


def _number(packet: bytes, at: int, size: int) -> int:
    return int.from_bytes(packet[at : at + size], "little")


def _has(packet: bytes, rows: Sequence[Sequence[int]]) -> bool:
    return all(_number(packet, at, size) == value % 256**size for at, size, value in rows)


def _stamped(table: StampedColumns, packet: bytes) -> Seen:
    columns = []
    for number in range(table.columns):
        at = table.first_column + number * table.column_bytes
        own = packet[at : at + table.column_bytes]
        stamp_ns = int.from_bytes(own[:8], "little", signed=True)
        position = _number(own, table.position_at, 2)
        is_measured = bool(own[table.status_at] & 1)
        frame = _number(own, table.frame_at, 2) if table.form_count == 0 else 0
        columns.append((stamp_ns, position, is_measured, frame))
    measured = [one for one in columns if one[2]]
    within = [one for one in measured if one[1] < table.positions]
    fault = BAD_HEADER if measured and not within else GOOD
    is_mine = True
    if table.form_count == 0:
        frame = columns[0][3]
        if len({(one[3], one[1] // table.columns) for one in measured}) > 1:
            fault = BAD_HEADER
    else:
        forms = _of(table, "forms").tolist()
        serials = [_number(packet, *form[1]) for form in forms]
        chosen = 0
        if table.serial and serials[0] != table.serial and table.serial in serials:
            chosen = serials.index(table.serial)
        is_mine = 0 in (serials[chosen], table.serial) or serials[chosen] == table.serial
        if _number(packet, *forms[chosen][0]) != table.packet_type:
            fault = BAD_HEADER
        frame = _number(packet, *forms[chosen][2])
    frame %= table.frames
    block = columns[0][1] // table.columns
    rank = int(_of(table, "rank")[block]) if block < table.rank_count else -1
    key = frame * table.packets_per_frame + rank
    if rank < 0:
        key = -1 - (frame * table.rank_count + block)
    return Seen(is_mine, fault, key, [(one[0], one[1], one in within) for one in columns])


def _paced(table: PacedBlocks, packet: bytes, host_ns: int) -> Seen:
    blocks = [packet[at * table.block_bytes :][:4] for at in range(table.block_count)]
    good = _of(table, "modes") is None or bool(_of(table, "modes")[packet[table.mode_at]])
    for block, flag in zip(blocks, _of(table, "flags").tolist(), strict=True):
        good &= _number(block, 0, 2) == flag and _number(block, 2, 2) <= table.circle
    firsts = [group * table.blocks_per_group * table.block_bytes for group in range(table.groups)]
    azimuth = [_number(packet, at + 2, 2) for at in firsts]
    azimuth = [0 if one == table.circle else one for one in azimuth]
    part_ns = _number(packet, table.stamp_at, 4) * 1000
    period_ns = table.period_ns
    good &= part_ns < period_ns
    near_ns = host_ns + table.clock_offset_ns
    packet_ns = part_ns + (near_ns - part_ns + period_ns // 2) // period_ns * period_ns

    speed = table.known_speed
    delay_ns = [0] * table.groups
    if table.groups > 1:
        # Steps back of less than `widest` are jitter.
        steps = [
            (after - before + table.widest) % table.circle - table.widest
            for before, after in itertools.pairwise(azimuth)
        ]
        most = max(table.widest, table.gap_factor * median_low(steps))
        plain = [step for step in steps if step <= most]
        speed = sum(plain) / len(plain) / table.group_ns
        is_known = abs(speed - table.known_speed) < table.tolerance * table.known_speed
        steady = table.known_speed if is_known else speed
        late_ns = 0.0
        for number, step in enumerate(steps, 1):
            if step > most and steady > table.slowest:
                late_ns += step / steady - table.group_ns
            delay_ns[number] = round(late_ns)
    per_s = speed * (_NS / table.circle) if table.follows_rotor else 0.0
    columns = []
    for column in range(table.columns):
        group = column * table.groups // table.columns
        turns = (azimuth[group] + speed * float(_of(table, "ahead_ns")[column])) / table.circle
        stamp_ns = packet_ns + delay_ns[group] + int(_of(table, "start_ns")[column])
        columns.append((stamp_ns, rotor_word(turns, per_s, 0), True))
    return Seen(True, GOOD if good else BAD_HEADER, None, columns)


def _dated_ns(table: DatedGroups, packet: bytes) -> int | None:
    """Time of a packet; None where the date or the time is none."""
    date = packet[table.date_at : table.date_at + 6]
    us = _number(packet, table.us_at, 4)
    if us > 10**6:
        return None
    if date[0] == 0:
        seconds = int.from_bytes(date[1:], "big")
        return None if seconds > 9 * 10**9 else seconds * _NS + us * 1000
    year = date[0] + (2000 if date[0] < 70 else 1900)
    try:
        month, day, hour, minute, second = date[1:]
        when = datetime(year, month, day, hour, minute, second, tzinfo=timezone.utc)
    except ValueError:
        return None
    return (when - _EPOCH) // timedelta(seconds=1) * _NS + us * 1000


def _dated(table: DatedGroups, packet: bytes) -> Seen:
    size = table.azimuth_bytes
    blocks = []
    for block in range(table.columns * table.returns):
        at = block * table.block_bytes
        ticks = _number(packet, table.azimuth_at + at, 2)
        if size == 3:
            ticks = ticks * 256 + packet[table.azimuth_at + at + 2]
        blocks.append((packet[table.first_block + at :][:2], ticks))
    good = _has(packet, _of(table, "checks").tolist())
    good &= _of(table, "modes") is None or bool(_of(table, "modes")[packet[table.mode_at]])
    good &= not table.has_flags or all(flag == b"\xff\xee" for flag, _ in blocks)
    packet_ns = _dated_ns(table, packet)
    good &= packet_ns is not None
    at = table.operation_at
    operation = 0 if at < 0 else packet[at] % table.operations
    speed = 0.0
    if table.rpm_at >= 0:
        rpm = int.from_bytes(packet[table.rpm_at :][:2], "little", signed=table.rpm_is_signed)
        speed = abs(rpm) * table.turns_per_s
    columns = []
    for column in range(table.columns):
        own = blocks[column * table.returns :][: table.returns]
        azimuth = own[0][1]
        good &= azimuth <= table.circle and all(ticks == azimuth for _, ticks in own)
        row = 0
        if table.loop_at >= 0:
            row = (packet[table.loop_at] + column + 1) % 2
        elif table.states_at >= 0:
            states = _number(packet, table.states_at, 2)
            state = states >> (14 - 2 * table.returns * column) & 3
            row = int(_of(table, "tables")[operation, state])
        first_ns = int(_of(table, "first_ns")[row])
        number = column - (table.columns - 1) * table.counts_back
        offset_ns = table.base_ns + int(_of(table, "step_ns")[operation]) * number // table.divisor
        turns = azimuth / table.circle + speed * ((first_ns - table.azimuth_ns) * 1e-9)
        stamp_ns = (packet_ns or 0) + offset_ns + first_ns
        columns.append((stamp_ns, rotor_word(turns, speed, row), True))
    at = table.sequence_at
    key = None if at < 0 else _number(packet, at, table.sequence_bytes)
    return Seen(True, GOOD if good else BAD_HEADER, key, columns)


def _timed_ns(table: TimedRows, packet: bytes) -> int | None:
    """Time of a packet; None where it is none."""
    time = packet[table.time_at : table.time_at + 10]
    high, low = int.from_bytes(time[6:8], "big"), int.from_bytes(time[8:], "big")
    if not table.is_calendar:
        second, micro = int.from_bytes(time[:6], "big"), high * 65536 + low
        return second * _NS + micro * 1000 if second < 2**33 and micro < 10**6 else None
    year, month, day, hour, minute, second = time[:6]
    limits = ((month, 1, 12), (day, 1, 31), (hour, 0, 23), (minute, 0, 59), (second, 0, 60))
    if not all(least <= value <= most for value, least, most in limits) or max(high, low) > 999:
        return None
    # Days beyond the end of a month run into the next.
    when = datetime(2000 + year, month, 1, hour, minute, tzinfo=timezone.utc) - _EPOCH
    when += timedelta(days=day - 1, seconds=second)
    return when // timedelta(seconds=1) * _NS + (high * 1000 + low) * 1000


def _timed(table: TimedRows, packet: bytes) -> Seen:
    is_mine = not _has(packet, _of(table, "foreign").tolist())
    if table.point_at >= 0:
        is_mine &= packet[table.point_at] == 0
    packet_ns = _timed_ns(table, packet)
    good = _has(packet, _of(table, "checks").tolist()) and packet_ns is not None
    rows = []
    for row in range(table.rows):
        own = packet[table.first_row + row * table.row_bytes :][:4]
        azimuth = int.from_bytes(own[2:], "big")
        valid = azimuth <= table.circle and _number(own, 0, table.row_id_bytes) == table.row_id
        rows.append((azimuth % table.circle, valid))
    half = table.circle // 2
    waits_ns, plain, gaps = [0], [], []
    for row, (before, after) in enumerate(itertools.pairwise(rows), 1):
        step = (after[0] - before[0] + half) % table.circle - half
        waits_ns.append(table.row_ns)
        if before[1] and after[1]:
            if table.repeats and step == 0:
                waits_ns[row] = 0
            elif abs(step) > table.widest:
                gaps.append((row, step))
            else:
                plain.append(step)
    known = table.known_speed
    if len(gaps) == 1 and known:
        row, step = gaps[0]
        forward = (step if known > 0 else -step) % table.circle
        waits_ns[row] = round(forward * (_NS / abs(known)))
    speed = sum(plain) * (_NS / table.row_ns) / len(plain) if plain else known
    columns = []
    for row, (azimuth, valid) in enumerate(rows):
        begin_ns = (packet_ns or 0) + sum(waits_ns[: row + 1])
        for start_ns in _of(table, "start_ns").tolist():
            turns = table.turns * (azimuth + speed * (start_ns / _NS))
            word = rotor_word(turns, table.following * speed, 0)
            columns.append((begin_ns + start_ns, word, valid))
    key = None
    if table.counter_at >= 0:
        key = int.from_bytes(packet[table.counter_at :][:4], "big")
    return Seen(is_mine, GOOD if good else BAD_HEADER, key, columns)


def _even(table: EvenColumns, packet: bytes) -> Seen:
    first_ns = int.from_bytes(packet[table.stamp_at :][:8], "little", signed=True)
    interval_ns = 0
    if table.interval_at >= 0:
        interval_ns = _number(packet, table.interval_at, 2) * table.interval_ns
    ring = 0 if table.ring_at < 0 else _number(packet, table.ring_at, 2) % table.rings
    columns = [
        (first_ns + interval_ns * number // table.columns, ring * 2**56, True)
        for number in range(table.columns)
    ]
    good = _has(packet, _of(table, "checks").tolist())
    key = None if table.counter_at < 0 else _number(packet, table.counter_at, 2)
    return Seen(True, GOOD if good else BAD_HEADER, key, columns)
