"""The paper's tables, and the additional ones of `lowfc validate`."""
