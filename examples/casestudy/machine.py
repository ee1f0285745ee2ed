"""The harvester of the scenarios, body frame: its box, and where its IMU is (without rotation)."""

from __future__ import annotations

# Large and constant, so that no point of the machine is left (the paper, section 2.2).
MACHINE_BOX = (-4.0, -2.5, 0.0, 8.5, 2.5, 5.0)
IMU_IN_BODY_M = (0.0, 0.0, 1.2)
