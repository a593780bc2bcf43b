"""MCAP logs: write, read, recover, copy."""
