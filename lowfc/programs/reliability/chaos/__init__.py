"""`lowfc chaos`: faults done to the real processes, and what must come of each."""
