"""`lowfc tune`: find the best law for a log or a running loop."""
