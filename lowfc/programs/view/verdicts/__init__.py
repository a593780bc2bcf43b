"""The state of a run: good, degraded or bad, by thresholds."""
