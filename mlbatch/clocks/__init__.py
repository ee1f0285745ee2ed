"""Timescales of sensors, their offsets, drifts and steps against the capture host."""
