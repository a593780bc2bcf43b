"""The digital twin: a compressed optical model, as accurate as the full chain and fast enough for the loop."""
