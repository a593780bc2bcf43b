"""The simulated sensor camera."""
