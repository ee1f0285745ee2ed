"""`python -m mlbatch.cli`."""

from mlbatch.cli import main

main()
