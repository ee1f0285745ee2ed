"""Windows against frame-level fusion of sweeps, on the same recording.

sweeps.py cuts sweeps and joins them to sets, statistics.py measures sets, compare.py runs both.
"""
