"""The launcher of the simulated loop."""
