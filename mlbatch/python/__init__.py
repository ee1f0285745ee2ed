"""Classes of the Python interface: opened recordings, runs and their reports."""
