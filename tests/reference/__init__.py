"""Documents as numbers, and literal implementations that share nothing with the package."""
