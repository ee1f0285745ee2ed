"""Several lidars behind one address: their packets cannot be told apart, and must not be mixed.

The columns of a packet follow those of the one before. Where packets of one stream overlap in
time, some of them or with the rotor elsewhere, or where stamps step to and fro, more than one lidar
sends. Repeated packets and packets out of order do not look so.
"""

from __future__ import annotations

import numpy as np

from mlbatch.geometry import rotor_ticks
from mlbatch.lidar import Lidar
from mlbatch.median import median
from mlbatch.streams import Found, Kind, Sampler, as_rows
from mlbatch.types import BoolArray, F64Array, Heads, I64Array
from mlbatch.units import NS_PER_MS, NS_PER_S

# Steps from packet to packet, by the time from the first to the last column of one: those that
# overlap, with a margin for rounded stamps, and those of packets with none between them.
_WITHIN, _NEXT = 0.95, 2.5
# Steps of several lidars, of those between packets that follow each other.
_MANY, _ALL = 0.15, 0.9
_FEWEST_STEPS = 8
# A rotor is elsewhere, by what it turns in a step, and by what angles are rounded to.
_ELSEWHERE, _RESOLUTION_TURNS = 0.25, 1e-3
_TURN = 2.0**32


def shared_by(sampler: Sampler, sensor: Found) -> str:
    """What is wrong with a sensor's stream that several lidars share, or ""."""
    for kind in sorted(sensor.kinds):
        if kind in sampler.samples:
            heads = _heads(sampler, kind, sensor.lidar)
            step_ns = _foreign_step_ns(heads, sensor.lidar)
            if step_ns is not None:
                span_ns = median(_spans_ns(heads))
                return (
                    f"sensor {sensor.name}: {sampler.table.streams[kind[0]]}: wanted packets of "
                    f"one {sensor.lidar.model}, got packets of {span_ns / NS_PER_MS:.3f} ms that "
                    f"step by {step_ns / NS_PER_MS:+.3f} ms: several lidars share the address; "
                    "give each an address or a port of its own and record again"
                )
    return ""


def _heads(sampler: Sampler, kind: Kind, lidar: Lidar) -> Heads:
    """Those of the good samples of a kind all of whose columns are valid."""
    packets = as_rows(sampler.samples[kind], kind[1])[:, : lidar.packet_size]
    hosts_ns = np.array(sampler.sample_host_ns[kind], np.int64)
    good = lidar.owns(packets) & (lidar.faults(packets) == 0)
    heads = lidar.heads(packets[good], hosts_ns[good])
    whole = heads.valid.all(axis=1)
    return Heads(heads.stamp_ns[whole], heads.encoder[whole], heads.valid[whole])


def _spans_ns(heads: Heads) -> F64Array:
    """(P,) from the first column of each packet to the last."""
    return np.asarray(heads.stamp_ns[:, -1] - heads.stamp_ns[:, 0], np.float64)


def _foreign_step_ns(heads: Heads, lidar: Lidar) -> float | None:
    """A usual step of those that one lidar cannot make; None where there are hardly any."""
    span_ns = _spans_ns(heads)
    step_ns = np.diff(heads.stamp_ns[:, 0]).astype(np.float64)
    near_ns = np.minimum(span_ns[1:], span_ns[:-1])
    to_and_fro = step_ns < -NS_PER_S
    overlaps = (step_ns != 0) & (np.abs(step_ns) < _WITHIN * near_ns)
    foreign = overlaps | to_and_fro
    steps = (step_ns != 0) & (np.abs(step_ns) < _NEXT * near_ns) | to_and_fro
    count, foreigners = int(np.count_nonzero(steps)), int(np.count_nonzero(foreign))
    if count < _FEWEST_STEPS or foreigners < _MANY * count:
        return None
    if foreigners > _ALL * count and not to_and_fro.any():
        # Either two lidars half a packet apart, or one whose pace is not what we know.
        rows = np.flatnonzero(steps)
        elsewhere = _off_course(heads, rows, step_ns[rows], lidar)
        if np.count_nonzero(elsewhere) < _MANY * count:
            return None
    return median(step_ns[foreign])


def _off_course(heads: Heads, rows: I64Array, step_ns: F64Array, lidar: Lidar) -> BoolArray:
    """At which of the steps (n,) from these packets the rotor did not turn as on the whole."""
    positions = lidar.beams.angle_rad
    first = heads.encoder[:, 0]
    angle = rotor_ticks(first) / _TURN if positions is None else first / len(positions)
    turned = np.diff(angle)[rows]
    turned -= np.rint(turned)
    usual = step_ns * (turned.sum() / max(abs(step_ns.sum()), 1.0))
    off = np.abs(turned - usual - np.rint(turned - usual))
    return np.asarray(off > np.maximum(_ELSEWHERE * np.abs(usual), _RESOLUTION_TURNS), np.bool_)
