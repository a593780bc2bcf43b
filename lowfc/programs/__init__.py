"""The processes and commands."""
