"""`python -m mlbatch`."""

from mlbatch.cli import main

main()
