"""`lowfc console`: a running loop on one screen, with buttons."""
