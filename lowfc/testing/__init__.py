"""For tests, ours and those of a driver: the bus in memory, the clock that stands still."""
