"""`lowfc gateway`: a loop offered to a control system, whose variables become bench values."""
