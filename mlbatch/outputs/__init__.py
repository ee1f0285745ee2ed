"""Scans as the Python interface gives them, and outputs of `convert` read back as such scans."""
