"""Calibrations, and the measurements from which they are made."""
