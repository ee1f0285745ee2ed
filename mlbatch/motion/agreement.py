"""Whether poses turn as the points do: scale, axes and delay of their rotation.

From window to window the points give a rotation (`motion/estimate.py`), and so do the poses. Both
are compared as they are, then with the rotation of the poses scaled, turned to other axes and
taken at another time. Poses are refused only where one of these, or all together, explain the
rotation of the points, and the difference matters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.se3 import log_rotation
from mlbatch.units import NS_PER_MS, NS_PER_S

# Fewer windows say little.
_LEAST_WINDOWS = 12
# Root mean square of the rotations in a window, rad; less is noise.
_LEAST_TURN = 3e-3
# A difference, rad a window, that matters: 10 mm at a distance of 20 m.
_HARM = 0.5e-3
# Of mean squares: the poses as they are, by the explanation.
_RATIO = 2.0
# All three together explain more than one of them.
_TOGETHER = 4.0
# Of the rotation: what an explanation may leave, and what may be left without one.
_LEFT = 0.35
_MOST_APART = 0.5
# Windows with the largest differences are left out: things that move, errors of registrations.
_KEPT_SHARE = 0.9
# Delays that are tried.
_FARTHEST_NS = NS_PER_S
_STEP_NS = 5 * NS_PER_MS
# Tolerances of a good rig; delays of filters and interfaces are several ms. A few windows of a
# steady turn do not give the delay: of simulated drives 0.2 % with 12 to 16 windows were 30 ms off.
_SCALE = 0.15
_TURNED_DEG = 10.0
_DELAY_NS = 12 * NS_PER_MS
_MANY_WINDOWS = 30
_DELAY_OF_FEW_NS = 60 * NS_PER_MS
# Least share of the poses' rotation that the points show, where nothing explains the difference.
_LEAST_SHOWN = 0.4
_SIGMAS = 2.0

# Why nothing can be said; words of the report.
FEW_WINDOWS = "few_windows"
LITTLE_ROTATION = "little_rotation"
UNCERTAIN = "uncertain"


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Rotation of the body, summed up: stamp_ns: (k,), increasing; total: (k, 3), rad."""

    stamp_ns: I64Array
    total: F64Array

    @classmethod
    def of_poses(cls, stamp_ns: I64Array, rotation: F64Array) -> Turns:
        """Sum up the rotation vectors between poses (k, 3, 3), each in the body before it."""
        back = rotation[:-1].transpose(0, 2, 1)
        steps = log_rotation(np.matmul(back, rotation[1:]))
        return cls(stamp_ns, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))

    def between(self, begin_ns: I64Array, end_ns: I64Array) -> F64Array:
        """Rotation vectors (..., 3) of spans (...,); none before the first pose, after the last."""
        return self._at(end_ns) - self._at(begin_ns)

    def _at(self, stamp_ns: I64Array) -> F64Array:
        first = int(self.stamp_ns[0])
        since, known = stamp_ns - first, self.stamp_ns - first
        return np.stack([np.interp(since, known, part) for part in self.total.T], axis=-1)


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the rotation of poses fits that of the points; windows: that were compared.

    fault: "scale", "axes", "delay", "all" of them, "none" that explains it, or ""; not_checked:
    why nothing can be said, or ""; scale: rotation of the poses by that of the points; turned_deg:
    between their axes; delay_ms: how late the poses are; known_ms: standard deviation of the delay.
    """

    windows: int = 0
    fault: str = ""
    not_checked: str = ""
    scale: float = 1.0
    turned_deg: float = 0.0
    delay_ms: float = 0.0
    known_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class _Fit:
    """An explanation; square: mean of what it leaves, rad2."""

    square: float
    scale: float = 1.0
    turned_deg: float = 0.0
    delay_ns: int = 0

    def fault(self, windows: int) -> str:
        """Name of the quantity beyond its tolerance; "all" for more than one."""
        most_ns = _DELAY_NS if windows >= _MANY_WINDOWS else _DELAY_OF_FEW_NS
        faults = (
            *(["scale"] if abs(math.log(self.scale)) > math.log(1.0 + _SCALE) else ()),
            *(["axes"] if self.turned_deg > _TURNED_DEG else ()),
            *(["delay"] if abs(self.delay_ns) > most_ns else ()),
        )
        return "all" if len(faults) > 1 else "".join(faults)


def agreement(turns: Turns, begin_ns: I64Array, end_ns: I64Array, seen: F64Array) -> Agreement:
    """Compare rotations; begin_ns, end_ns: (n,), of spans; seen: (n, 3), rad, from the points."""
    count = len(seen)
    if count < _LEAST_WINDOWS or len(turns.stamp_ns) < 2:
        return Agreement(count, not_checked=FEW_WINDOWS)
    own = turns.between(begin_ns, end_ns)
    own_size, size = _size(own), _size(seen)
    if max(size, own_size) < _LEAST_TURN:
        return Agreement(count, not_checked=LITTLE_ROTATION)
    as_is = float(_trimmed(seen - own))
    fits = _fits(turns, begin_ns, end_ns, seen)
    found = min(fits[:3], key=lambda fit: fit.square)
    if fits[3].square * _TOGETHER < found.square:
        found = fits[3]
    # All that is known where the poses are right: the small differences.
    fine = fits[3]
    result = Agreement(
        count,
        scale=fine.scale,
        turned_deg=fine.turned_deg,
        delay_ms=fine.delay_ns / NS_PER_MS,
        known_ms=_known_ms(turns, begin_ns, end_ns, fine.square),
    )
    if as_is <= _HARM**2:
        return result
    is_explained = found.square < (_LEFT * size) ** 2 and as_is > _RATIO * found.square
    fault = found.fault(count) if is_explained else ""
    if fault:
        return replace(
            result,
            fault=fault,
            scale=found.scale,
            turned_deg=found.turned_deg,
            delay_ms=found.delay_ns / NS_PER_MS,
        )
    if own_size >= _LEAST_TURN:
        shown = float((own * seen).sum() / (own**2).sum())
        spread = size / (own_size * math.sqrt(3.0 * count))
        if shown + _SIGMAS * spread < _LEAST_SHOWN:
            return replace(result, fault="none")
    if as_is > (_MOST_APART * max(size, own_size)) ** 2:
        return Agreement(count, not_checked=UNCERTAIN)
    return result


def _fits(turns: Turns, begin_ns: I64Array, end_ns: I64Array, seen: F64Array) -> list[_Fit]:
    """The best scale, axes and delay, and all together."""
    steps = _FARTHEST_NS // _STEP_NS
    delays_ns = np.arange(-steps, steps + 1) * _STEP_NS
    reported_turns = turns.between(begin_ns + delays_ns[:, None], end_ns + delays_ns[:, None])
    energy = np.maximum((reported_turns**2).sum(axis=(1, 2)), 1e-12)
    # Orthogonal Procrustes: the axes that fit best, of either hand.
    left, stretch, right = np.linalg.svd(np.matmul(seen.T, reported_turns))
    turned = np.matmul(reported_turns, np.matmul(left, right).transpose(0, 2, 1))
    # Of the angle by which the rotations themselves are turned, not axes that show none.
    cosine = (turned * reported_turns).sum(axis=(1, 2)) / energy
    turned_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    share = stretch.sum(axis=1) / energy
    late = _trimmed(seen - reported_turns)
    whole = _trimmed(seen - share[:, None, None] * turned)
    own = reported_turns[steps]
    shown = max(float((own * seen).sum() / energy[steps]), 1e-6)
    at, all_at = int(late.argmin()), int(whole.argmin())
    return [
        _Fit(float(_trimmed(seen - shown * own)), scale=1.0 / shown),
        _Fit(float(_trimmed(seen - turned[steps])), turned_deg=float(turned_deg[steps])),
        _Fit(float(late[at]), delay_ns=int(delays_ns[at])),
        _Fit(
            float(whole[all_at]),
            1.0 / max(float(share[all_at]), 1e-6),
            float(turned_deg[all_at]),
            int(delays_ns[all_at]),
        ),
    ]


def _known_ms(turns: Turns, begin_ns: I64Array, end_ns: I64Array, square: float) -> float:
    """Standard deviation of the delay: what is left, by how rotations change with time."""
    late = turns.between(begin_ns + _STEP_NS, end_ns + _STEP_NS)
    change = (late - turns.between(begin_ns, end_ns)) / (_STEP_NS / NS_PER_MS)
    return math.sqrt(square / 3.0 / max(float((change**2).sum()), 1e-12))


def _size(rotations: F64Array) -> float:
    return math.sqrt(float((rotations**2).sum(axis=1).mean()))


def _trimmed(differences: F64Array) -> F64Array:
    """Mean squares (...,) of differences (..., n, 3), without the largest ones."""
    squares = np.sort((differences**2).sum(axis=-1), axis=-1)
    kept: F64Array = squares[..., : math.ceil(_KEPT_SHARE * squares.shape[-1])].mean(axis=-1)
    return kept
