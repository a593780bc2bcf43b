"""The compressed optical model: as exact as the full chain, and fast enough for the loop."""
