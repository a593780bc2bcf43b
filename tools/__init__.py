"""What makes the documentation's tables, pictures and layouts: `python -m tools.measure`."""
