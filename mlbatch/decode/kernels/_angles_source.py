"""A kernel for cosines and sines of rotor words: those of numpy to the last bit, or none.

Source: reduction and polynomials of fdlibm (`e_rem_pio2.c`, `k_sin.c`, `k_cos.c`), which are right
to a unit of the last place of a float64. Nearly always that tells the float32 that is wanted; where
it does not, numpy has to be asked.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, f4_at, i8_at, piece

_TICKS = (1 << 32) - 1
_RAD = 2 * np.pi / 2**32
_QUARTERS = 2 / np.pi
# A quarter of a turn in two parts: products of the first with numbers below 2**20 are exact.
_QUARTER, _REST = 1.57079632673412561417e00, 6.07710050650619224932e-11
_S1, _S2, _S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
_S4, _S5, _S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
_C1, _C2, _C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
_C4, _C5, _C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11
# More than what these and numpy's (4 units of the last place at most) are off together.
_OFF = 2.0**-49
_NAN = np.float32("nan")


def build() -> Callable[[Pointer], int]:
    """Takes the frame ANGLES to ANGLE_SIZE of `frame.py`; gives how many are left to numpy."""
    cosine_of, sine_of = _cosine(), _sine()

    def kernel(frame: Pointer) -> int:
        words = i8_at(frame[at.ANGLE_WORDS])
        cosines, sines = f4_at(frame[at.ANGLE_COSINE]), f4_at(frame[at.ANGLE_SINE])
        left = 0
        for number in range(frame[at.ANGLES]):
            angle = np.float64(words[number] & _TICKS) * _RAD
            quarter = np.int32(angle * _QUARTERS + 0.5)
            turned = np.float64(quarter)
            rest = (angle - turned * _QUARTER) - turned * _REST
            along, aside = cosine_of(rest), sine_of(rest)
            is_odd = quarter & 1 != 0
            cosine, sine = (aside, along) if is_odd else (along, aside)
            cosine = -cosine if quarter + 1 & 2 != 0 else cosine
            sine = -sine if quarter & 2 != 0 else sine
            is_sure = np.float32(cosine - _OFF) == np.float32(cosine + _OFF)
            is_sure &= np.float32(sine - _OFF) == np.float32(sine + _OFF)
            cosines[number] = np.float32(cosine) if is_sure else _NAN
            sines[number] = np.float32(sine)
            left += 0 if is_sure else 1
        return left

    return kernel


def _cosine() -> Callable[[float], float]:
    @piece
    def cosine(angle: float) -> float:
        """Of an eighth of a turn at most."""
        square = angle * angle
        tail = square * (_C3 + square * (_C4 + square * (_C5 + square * _C6)))
        return 1.0 - (0.5 * square - square * square * (_C1 + square * (_C2 + tail)))

    return cosine


def _sine() -> Callable[[float], float]:
    @piece
    def sine(angle: float) -> float:
        """Of an eighth of a turn at most."""
        square = angle * angle
        tail = square * (_S3 + square * (_S4 + square * (_S5 + square * _S6)))
        return angle + angle * square * (_S1 + square * (_S2 + tail))

    return sine
