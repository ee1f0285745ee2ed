"""What a session of recordings contains: sensors, calibrations, extrinsics."""
