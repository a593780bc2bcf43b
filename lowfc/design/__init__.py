"""How good a sensor can be, how good an estimator is, and the search for better masks: pure functions of arrays."""
