"""`lowfc latency`: how long a frame takes to become a command."""
