"""Comparison with other implementations of the same loop, on one host, in turns.

lowfc does not need this package. `python -m benchmarks peers --help` describes its use.
"""
