"""`lowfc acceptance`: what a loop must show before it is used, each test by itself."""
