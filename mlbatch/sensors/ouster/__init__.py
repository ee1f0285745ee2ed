"""Ouster lidars; `sensor.py` is the plug-in."""
