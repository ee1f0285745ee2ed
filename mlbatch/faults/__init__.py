"""Fault injection: packets dropped, damaged, reordered, repeated or delayed, and clocks changed.

specs.py parses what users write; replay.py applies it to the packets of a session.
"""

from mlbatch.faults.replay import FaultCount, FaultLedger, FaultReplay
from mlbatch.faults.specs import KINDS, Fault, parse_fault

__all__ = ["KINDS", "Fault", "FaultCount", "FaultLedger", "FaultReplay", "parse_fault"]
