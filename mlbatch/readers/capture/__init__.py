"""Packet captures: frames, datagrams, fragments."""
