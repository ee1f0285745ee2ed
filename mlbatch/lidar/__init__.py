"""The interface between vendors and decoding: lidars, beam geometry, pixel layouts."""
