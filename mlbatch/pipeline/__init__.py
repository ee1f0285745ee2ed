"""One run: packets of a session to the scans of an output."""
