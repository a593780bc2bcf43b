"""The digital twin: a compressed model, fast enough for the loop; its images agree with the full chain's to 1e-4."""
