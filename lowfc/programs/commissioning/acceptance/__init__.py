"""`lowfc acceptance`: the tests that a loop must pass before it is used."""
