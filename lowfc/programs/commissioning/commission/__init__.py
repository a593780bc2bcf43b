"""`lowfc commission`: from a running camera and mirror to a calibrated, closed loop."""
