"""`lowfc soak`: run the simulated loop for hours; check for growth of memory and for lost messages."""
