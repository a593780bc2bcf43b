"""`lowfc what-if`: predict from a log the residual with other gains, another reconstructor or another controller."""
