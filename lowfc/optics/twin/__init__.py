"""The digital twin: a compressed optical model, within 1e-4 of the full chain and fast enough for the loop."""
