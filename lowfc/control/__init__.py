"""Estimation, control law, requests, safety and stability, without clock, file or bus; mostly pure functions."""
