"""Calibrations and what is measured to make them."""
