"""Interfaces to the host: bus, clock, files, scheduling."""
