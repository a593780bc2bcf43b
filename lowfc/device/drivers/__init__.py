"""Drivers of the field's own interfaces, found by their entry points."""
