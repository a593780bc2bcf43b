"""Diffraction from the telescope pupil to sensor and science image, detectors, the digital twin: pure functions."""
