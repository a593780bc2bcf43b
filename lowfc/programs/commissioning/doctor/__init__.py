"""`lowfc doctor`: check whether this host is fit for a real-time loop."""
