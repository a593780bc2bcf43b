"""Faults and long runs."""
