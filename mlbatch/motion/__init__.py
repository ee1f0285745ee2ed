"""Poses of the body over time, and what moves columns to the pose at one instant."""
