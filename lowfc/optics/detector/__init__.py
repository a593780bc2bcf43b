"""Photons and detectors."""
