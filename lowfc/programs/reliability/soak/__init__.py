"""`lowfc soak`: run the simulated loop for hours; check memory growth, drift of the latency and lost messages."""
