"""The digital twin: a compressed model, within 1e-4 of the full chain (built-in sensors), fast enough for the loop."""
