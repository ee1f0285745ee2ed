"""All conversion factors, in one place."""

from __future__ import annotations

import math

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000
M_PER_MM = 1e-3
MM_PER_M = 1000
RAD_PER_DEG = math.pi / 180.0
# Standard gravity, CGPM 1901; Ouster's legacy IMU packets count in it.
STANDARD_GRAVITY = 9.80665
