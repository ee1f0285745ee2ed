"""Ouster lidars: packets from measured distances."""
