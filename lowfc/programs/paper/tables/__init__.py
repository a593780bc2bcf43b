"""The paper's tables, and the additional tables of `lowfc validate`."""
