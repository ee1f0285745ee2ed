"""Coordinate frames: transforms, trees of frames, URDF."""
