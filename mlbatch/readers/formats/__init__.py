"""Plug-ins: one module a container of recordings."""
