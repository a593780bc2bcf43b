"""`lowfc acceptance`: acceptance tests of a loop against its requirements."""
