"""The arithmetic of one frame: the reference in numpy, and the compiled (fused) step for normal frames."""
