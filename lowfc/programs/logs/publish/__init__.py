"""A log back on the bus, in its own time."""
