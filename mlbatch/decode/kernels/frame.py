"""The frame of the kernels that decode: what stands where, for those who call and who compile.

Addresses are those of C-contiguous arrays, 0 where something is not wanted. A column has the
channels of one kind of sensor; P is their number rounded up to a power of two, for which the kernel
is compiled, E = returns * P the elements of a column (`return * P + channel`).
"""

from __future__ import annotations

# Columns in the order of the scan, of all kinds: the first that is to be decoded, and the one after
# the last; stamps, numbers of sensors, places and encoder words (addresses of int64); start of the
# scan, ns; number of column 0 in the scan.
(BEGIN, END, STAMP_NS, SENSOR, PLACE, ENCODER, START_NS, FIRST_NUMBER) = range(8)
# int64 of each sensor: its number among the members of the kind, -1 for other kinds.
MEMBER = 8
# (members, 5) int64: address of the columns in the ring, its rows, columns of a row, bytes from row
# to row and from column to column.
RINGS = 9
# float32 of the columns of the kind: cosine and sine of the rotor's angle.
(COSINE, SINE) = range(10, 12)
# Slots of a column; runs of a return, (returns, runs, 3) int64: first byte, first channel,
# channels; bit fields, (returns, 9) int64: word, shift and mask of distance, level, reflectivity;
# factor and divisor, float32; largest silent distance; dark channels, int64, and how many.
(SLOTS, RUNS, RUN_COUNT, FIELDS, SCALE, SILENT, DARK, DARK_COUNT) = range(12, 20)
# Tabled: (rows, 3, P) and (rows, 3) float32; int64 first row of each member; rows.
# Turning: (members, 3, 3, P) float32 vectors each; (members,) int64 bits, one an axis: vectors 1
# and 2 count (from bit 0), vector 3 counts (from bit 3); the same of origins (from bit 6).
(DIRECTION, ORIGIN, FIRST_ROW, ROWS, VECTORS) = range(20, 25)
# (members, P) float32, added to ranges (0: nothing is); (members * T, P) float32, firing times in
# ns (0: all fire at once), and T, how many tables of them a member has.
(REACH, FIRING, TABLES) = range(25, 28)
# (members * T, E) int64 words; (T, slots) int64, elements in the order of firing (0: as they lie),
# of all members, and the step from table to table, 0 if all share one; how types of two returns are
# told: 0 not, 1 by range, 2 also by level; whether a lone return is sent twice; and dropped then.
(LABELS, ORDER, ORDER_STEP, TYPED, SENT_TWICE, DROPS_REPEATED) = range(28, 34)
# (members, 2) float32, lowest and highest range; (k, 6) float32 boxes, and k.
(LIMITS, BOXES, BOX_COUNT) = range(34, 37)
# (members, 5) int64, added to: columns; slots with a return; of these not repeated; in range;
# outside of boxes.
COUNTS = 37
# Outputs: points (rows, 4) float32, labels int64, ranges float32, reflectivities uint16, columns
# uint32. Whether the sensors have reflectivity, and it is wanted.
(POINT, LABEL, RANGE, REFLECTIVITY, COLUMN, HAS_REFLECTIVITY) = range(38, 44)
# Organized: slots of a row, 0 for dense scans; (E,) int64, slot of each element.
(WIDTH, SLOT) = range(44, 46)
# Bytes of a column's record.
RECORD_BYTES = 46
# Row of the first point; how many columns of the kind come before the first one, which a kernel
# counts on.
(ROW, NUMBER) = range(47, 49)
# What numpy decoded, to be copied: points of every column, int64; planes of the dense points of the
# kind alone. NUMBER is then the row among these.
(POINTS, PART_POINT, PART_LABEL, PART_RANGE, PART_REFLECTIVITY) = range(49, 54)
SIZE = 54

# Scans of several kinds: columns; the kind of each sensor, sensors (addresses of int64); (kinds, 2)
# int64, addresses of kernels and of their frames; row of the first point.
(RELAYED, RELAY_KIND, RELAY_SENSOR, RELAY_KERNELS, RELAY_ROW) = range(5)
RELAY_SIZE = 5

# Rotor words: how many; the words (int64); their cosines and sines (float32), NaN and anything
# where numpy has to tell.
(ANGLES, ANGLE_WORDS, ANGLE_COSINE, ANGLE_SINE) = range(4)
ANGLE_SIZE = 4

# Outlines: columns; stamps, sensors and encoder words (addresses of int64); sensors of the rig;
# int64 of each: positions of a turn, 0 for rotor words; (sensors, sectors) scratch; (sensors,
# OUTLINE_FIGURES) what is found.
(OUTLINED, OUTLINE_STAMP_NS, OUTLINE_SENSOR, OUTLINE_ENCODER, OUTLINE_SENSORS) = range(5)
(OUTLINE_POSITIONS, OUTLINE_PASSES, OUTLINE_FOUND) = range(5, 8)
OUTLINE_SIZE = 8
OUTLINE_FIGURES = 6
