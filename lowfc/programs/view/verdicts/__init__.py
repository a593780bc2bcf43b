"""Judgement on a run: good, degraded, wrong."""
