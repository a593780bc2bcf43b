"""The live view: what an operator sees of a run, live or from its log."""
