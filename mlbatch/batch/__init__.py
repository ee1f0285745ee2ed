"""Many recordings: one `mlbatch convert` process per session, see docs/batch.md.

There is no database: the state of a session is what lies in its folder.
"""
