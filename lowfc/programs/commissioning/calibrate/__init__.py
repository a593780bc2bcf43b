"""`lowfc calibrate`: measure I0 and H on a running loop and compute R, or compute all three from its optical model."""
