"""`lowfc recorder`: everything that is sent, into a log."""
