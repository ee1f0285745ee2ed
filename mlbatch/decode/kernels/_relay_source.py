"""A kernel that decodes scans of several kinds of sensors: their kernels take turns.

Each writes its points behind those of the one before, so that none is moved again.
"""

from __future__ import annotations

from collections.abc import Callable

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, call_kernel, i8_at, piece
from mlbatch.decode.kernels._records_source import AHEAD, asking

_KERNEL, _FRAME, _WORDS = range(3)


def build() -> Callable[[Pointer], int]:
    """Takes the frame RELAYED to RELAY_SIZE of `frame.py`; gives the row after the last point."""
    ask, frame_of = asking(), _frame_of()

    def kernel(frame: Pointer) -> int:
        kinds, sensors = i8_at(frame[at.RELAY_KIND]), i8_at(frame[at.RELAY_SENSOR])
        count, row, begin, asked = frame[at.RELAYED], frame[at.RELAY_ROW], 0, 0
        while begin < count:
            kind, end = kinds[sensors[begin]], begin + 1
            while end < count and kinds[sensors[end]] == kind:
                end += 1
            # A kernel asks for its own records while it runs, not for those of the next one.
            asked = max(asked, end)
            while asked < min(end + AHEAD, count):
                ask(frame_of(frame, kinds[sensors[asked]]), asked)
                asked += 1
            own = frame_of(frame, kind)
            own[at.BEGIN], own[at.END], own[at.ROW] = begin, end, row
            row = call_kernel(i8_at(frame[at.RELAY_KERNELS])[kind * _WORDS + _KERNEL], own)
            begin = end
        return int(row)

    return kernel


def _frame_of() -> Callable[[Pointer, int], Pointer]:
    @piece
    def frame_of(frame: Pointer, kind: int) -> Pointer:
        """The frame of the kernel of a kind."""
        return i8_at(i8_at(frame[at.RELAY_KERNELS])[kind * _WORDS + _FRAME])

    return frame_of
