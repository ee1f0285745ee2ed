"""Velodyne lidars: packets from measured distances."""
