"""ROBOSENSE lidars: packets from measured distances; `lidar.py` is the simulator."""
