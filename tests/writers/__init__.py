"""Tests of mlbatch.writers."""
