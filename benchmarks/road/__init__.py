"""The road down: what each measure taken against latency bought, in turns with the loop as it is."""
