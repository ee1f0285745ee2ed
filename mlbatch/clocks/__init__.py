"""Clocks of sensors: timescale, offset, drift and steps relative to the capture host.

`timescale` names what a clock counts; `envelope` and `steps` estimate how it runs, from the stamps
and receive times of packets; `watch` is the estimator of one sensor; `compare` decides whether
several clocks may be merged; `align` maps clocks onto another one (docs/clocks.md).
"""
