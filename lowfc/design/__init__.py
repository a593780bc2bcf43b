"""Bounds on a sensor's noise, the accuracy of estimators, and the search for better masks: pure functions of arrays."""
