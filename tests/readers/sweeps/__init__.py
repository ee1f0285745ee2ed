"""Folders of sweeps."""
