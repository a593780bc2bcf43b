"""For tests of lowfc and of drivers: an in-memory bus, a clock that the test advances."""
