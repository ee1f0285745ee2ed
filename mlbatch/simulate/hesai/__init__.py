"""HESAI lidars: packets from measured distances."""
