"""Packet, column and point accounting; report.json, scans.csv and the summary."""
