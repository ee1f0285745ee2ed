"""What the documents say, as numbers that share nothing with the package."""
