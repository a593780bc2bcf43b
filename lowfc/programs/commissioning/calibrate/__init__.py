"""`lowfc calibrate`: I0, H and R of a running loop, or of its optical model."""
