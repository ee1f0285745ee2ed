"""Programs that run in the environments of consumers: they print a JSON document of what they read.

They import the consumer and numpy, nothing of mlbatch.
"""
