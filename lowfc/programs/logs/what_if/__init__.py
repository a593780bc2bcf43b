"""`lowfc what-if`: a log under other gains, another reconstructor or another law."""
