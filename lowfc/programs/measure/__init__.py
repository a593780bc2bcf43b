"""Measurements of speed and latency."""
