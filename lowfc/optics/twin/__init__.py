"""The digital twin: a compressed model of the optics, fast enough for the loop.

Its images differ from those of the full chain by less than 1e-4 (relative l2 norm, built-in sensors).
"""
