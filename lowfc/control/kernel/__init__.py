"""The arithmetic of one frame: the reference in numpy, and the fused step that gives the same in the usual case."""
