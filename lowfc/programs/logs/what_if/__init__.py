"""`lowfc what-if`: a log with other gains, another reconstructor or another controller."""
