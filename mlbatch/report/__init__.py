"""Packet, column and point accounting; report.json, scans.csv and the summary."""

from mlbatch import make_callable

make_callable(__name__)
