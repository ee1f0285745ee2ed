"""Unmodified programs of others that read our outputs, each in an environment of its own."""
