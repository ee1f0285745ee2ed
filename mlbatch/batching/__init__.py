"""Batching by timestamp (Faitli et al. 2025, section 2.1): columns in, windows out.

`grid` and `windows` define the windows, `intake` filters the packets of one sensor, `batcher`
merges the columns of all sensors, `loss` counts missing packets. `reference` implements the same
rules independently, in plain loops; tests compare both.
"""
