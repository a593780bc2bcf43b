"""Access to the host: bus, clock, files, scheduling."""
