"""Fault injection: packets dropped, delayed, repeated or damaged on purpose."""
