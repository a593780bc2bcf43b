"""Estimation, control law, safety and stability: pure functions of arrays."""
