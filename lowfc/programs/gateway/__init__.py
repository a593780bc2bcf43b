"""`lowfc gateway`: serve a loop's variables to a control system, and read the control system's as bench values."""
