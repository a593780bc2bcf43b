"""`lowfc info` and `lowfc recover`: what a log holds, and what can be saved of a damaged one."""
