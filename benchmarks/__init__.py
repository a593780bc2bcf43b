"""Benchmarks of the loop; `python -m benchmarks --help` lists them."""
