"""`lowfc gateway`: serve a loop to a control system, and read its variables as bench values."""
