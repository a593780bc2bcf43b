"""A contest: other ways to close the same loop, at the same sizes, on this host, at the same time.

Nothing here is needed to run lowfc. `python -m benchmarks peers --help` says how it is run.
"""
