"""`lowfc soak`: run the simulated loop for hours; check memory growth, drift of the figures and lost messages."""
