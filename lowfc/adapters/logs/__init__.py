"""MCAP logs: written, read, recovered, copied."""
