"""What makes the documentation's tables and pictures: `python -m tools.measure`."""
