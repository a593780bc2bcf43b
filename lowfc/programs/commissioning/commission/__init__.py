"""`lowfc commission`: from a camera that publishes and a mirror that follows to a closed loop."""
