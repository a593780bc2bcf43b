"""`lowfc validate`: reproduce the paper's tables and figures, and compare with published results."""
