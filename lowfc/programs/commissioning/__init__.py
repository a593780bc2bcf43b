"""Commissioning: calibration, tuning, acceptance tests, checks of drivers and hosts."""
