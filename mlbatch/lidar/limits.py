"""Limits of lengths in calibrations: what a spinning lidar, and a vehicle, can be.

Beams of known lidars leave within 0.28 m of the origin of the sensor frame (HDL-64E), and within
0.1 m in most. Ranges are measured from there: `verify` accepts distances from the sensor that
differ from the range by up to 1 m from point to point.
"""

from __future__ import annotations

# Of a beam's origin, or of the lidar frame, from the origin that it is given in.
MAX_ORIGIN_M = 1.0
# Of the place where a beam leaves from the origin of the sensor frame.
MAX_BEAM_M = 0.5
# Between largest and smallest range correction of a sensor's beams, and the offset of a beam.
MAX_SPREAD_M = 1.0
# Of a sensor from the body, in a calibration, and by any source: float32 resolves 1 mm there.
MAX_POSE_M = 100.0
MAX_TRANSLATION_M = 10_000.0
# Of a sensor from the origin of a vehicle's body; millimetres that are read as metres are beyond.
FAR_POSE_M = 20.0
