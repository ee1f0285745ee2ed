"""Example plug-ins of mlbatch: a reader, a sensor and a writer."""
