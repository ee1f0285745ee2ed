"""Packets of lidars of any vendor by the encoders of simulate, and what is needed to read them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai.angles import Angles, Beams, MirrorAngles, angles_csv, fan
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.velodyne import encode as velodyne

Spec: TypeAlias = velodyne.VelodyneSpec | hesai.HesaiSpec | robosense.RobosenseSpec
# Receive time in ns, and payload.
Payloads: TypeAlias = list[tuple[int, bytes]]
_HOUR_NS = 3_600_000_000_000


def shape(spec: Spec, packets: int) -> tuple[int, int, int]:
    """Columns, channels and returns of so many packets."""
    if isinstance(spec, hesai.HesaiSpec):
        return packets * spec.groups, spec.row.channels, spec.returns
    columns = round(packets * spec.columns_per_packet)
    if isinstance(spec, robosense.RobosenseSpec):
        return columns, spec.row.channels, spec.returns
    return columns, len(spec.table.elevation_deg), spec.returns


def encoded(spec: Spec, counts: I64Array, levels: I64Array) -> Payloads:
    """Packets of ranges and levels as on the wire, (columns, channels, returns) each."""
    if isinstance(spec, velodyne.VelodyneSpec):
        return listed(velodyne.encode(spec, counts, levels))
    if isinstance(spec, robosense.RobosenseSpec):
        return robosense.msop(spec, counts, levels)
    payloads = hesai.encode_packets(spec, counts, levels)
    return list(zip(hesai.host_times_ns(spec, len(payloads)).tolist(), payloads, strict=True))


def even(spec: Spec, packets: int, count: int, level: int) -> Payloads:
    """Packets of equal readings."""
    size = shape(spec, packets)
    return encoded(spec, np.full(size, count), np.full(size, level))


def listed(sent: velodyne.Sent) -> Payloads:
    """(receive time, payload)."""
    rows = [payload.tobytes() for payload in sent.payloads]
    return list(zip(sent.host_ns.tolist(), rows, strict=True))


def firing_ns(spec: Spec, payloads: Payloads) -> I64Array:
    """(columns, channels in the order of the wire) when they fire, by what the packets say."""
    columns, _, _ = shape(spec, len(payloads))
    if isinstance(spec, hesai.HesaiSpec):
        return hesai.firing_times_ns(spec, columns)
    if isinstance(spec, robosense.RobosenseSpec):
        return robosense.firing_times_ns(spec, np.arange(columns))
    fires_ns = velodyne.firing_times_ns(spec, np.arange(columns))
    # Stamps are whole us past the hour, each of the first firing of a packet.
    said_us = np.array([int.from_bytes(data[1200:1204], "little") for _, data in payloads])
    first_ns = fires_ns[:: spec.columns_per_packet].min(axis=1)
    off_ns = said_us * 1000 - round(spec.table.stamp_after_us * 1000) - first_ns
    off_ns = (off_ns + _HOUR_NS // 2) % _HOUR_NS - _HOUR_NS // 2
    said_ns: I64Array = fires_ns + off_ns.repeat(spec.columns_per_packet)[:, None]
    return said_ns


def hesai_unit(model: str, channels: int) -> tuple[Beams, str, bytes]:
    """Angles of a HESAI, and the name and content of its file."""
    elevation, azimuth = fan(model, channels)
    if model == "AT128":
        mirrors = MirrorAngles((20.0, 140.0, 260.0), elevation, azimuth)
        return mirrors, "unit.dat", mirrors.dat()
    return Angles(elevation, azimuth), "unit.csv", angles_csv(elevation, azimuth)
