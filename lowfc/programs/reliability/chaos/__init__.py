"""`lowfc chaos`: inject faults into the real processes and check the loop's response."""
