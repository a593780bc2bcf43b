"""`lowfc soak`: run the simulated loop for hours; check for growth, drift and loss."""
