"""`lowfc validate`: the paper's tables and figures, reproduced: paper, measured, limit, assumption."""
