"""Windows against frame-level fusion of sweeps, on the same recording.

compare.py measures sets of sweeps (batching/sweeps.py) and windows, instant.py finds where they
differ most.
"""
