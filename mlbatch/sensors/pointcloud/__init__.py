"""Decoded point clouds as a lidar; `sensor.py` is the plug-in."""
