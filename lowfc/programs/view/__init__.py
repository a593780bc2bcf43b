"""The operator's view of a run, live or from its log."""
