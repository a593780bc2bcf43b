"""Test helpers for lowfc and for drivers: an in-memory bus and a clock that the test advances."""
