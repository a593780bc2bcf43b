"""`lowfc calibrate`: measure I0, H and R on a running loop, or compute them from its optical model."""
