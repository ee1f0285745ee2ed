"""How fast mlbatch is on this machine: standard recordings, whole processes, floors and peers.

Nothing here imports numpy at the top of a module that the measuring process loads: Linux counts a
parent's pages at the fork into the peak of its child (measure.py).
"""

from __future__ import annotations
