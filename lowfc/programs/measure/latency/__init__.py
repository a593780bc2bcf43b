"""`lowfc latency`: measure the latency from frame to command."""
