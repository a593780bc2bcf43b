"""Diffraction from the telescope pupil to the sensor image: pure functions of arrays."""
