"""Windows against frame-level fusion of sweeps, on the same recording.

statistics.py measures sets of sweeps (batching/sweeps.py), compare.py runs both.
"""
