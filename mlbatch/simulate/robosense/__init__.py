"""ROBOSENSE lidars: packets from measured distances."""
