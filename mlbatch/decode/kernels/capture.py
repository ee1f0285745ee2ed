"""The frame of the kernel that reads captures: what stands where, for its callers and its source.

Addresses are those of C-contiguous arrays; all columns are int64. Whoever calls has made sure that
what is read and written lies within the arrays.
"""

from __future__ import annotations

TASK = 0
WALK, DISSECT, COPY = range(3)

# WALK: the file's bytes, from where to where there are whole ones; whether numbers begin with their
# high byte; ns of a unit of the fraction; the longest frame; room in the columns; and these: first
# byte, bytes in the file and on the wire, arrival. Gives the number of frames, and in its frame
# where the next record begins and why it ends there: no room, no whole record, a frame too long.
(BYTES, BEGIN, END, IS_SWAPPED, UNIT_NS, MOST_BYTES, ROOM) = range(1, 8)
(START, CAPTURED, ORIGINAL, HOST_NS) = range(8, 12)
(NEXT, WHY) = range(12, 14)
(NO_ROOM, CUT, TOO_LONG) = range(3)

# DISSECT: the bytes and their number; Ethernet frames and their columns START, CAPTURED, ORIGINAL;
# what is found: (5, room) frame, first byte, size, source, port of whole datagrams; (8, room)
# frame, source, destination, ident, offset, more, first byte, size of fragments; (room) others.
# Gives the number of datagrams, and in its frame those of the others.
SIZE_BYTES = 2
(FRAMES, DATAGRAMS, FRAGMENTS, OTHERS) = range(14, 18)
(FRAGMENTS_FOUND, OTHERS_FOUND) = range(18, 20)

# COPY: how many runs; from where, first bytes and sizes; to where, first bytes.
(RUNS, SOURCE, SOURCE_AT, RUN_BYTES, TARGET, TARGET_AT) = range(20, 26)
FRAME_SIZE = 26
