"""`lowfc console`: operate a running loop from one screen."""
