"""Benchmark of mlbatch on this machine: standard recordings, whole processes, floors and peers.

Modules that the measuring process loads do not import numpy: Linux counts a parent's pages at the
fork in the peak memory of its child (measure.py).
"""
