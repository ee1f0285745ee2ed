"""Rig files: the sensors, extrinsics and streams of one vehicle."""
