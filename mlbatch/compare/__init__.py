"""Window scans against frame-level fusion of the sweeps of drivers."""
