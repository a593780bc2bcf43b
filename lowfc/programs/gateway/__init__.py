"""`lowfc gateway`: serve a loop to a control system, and publish its variables on the bus for interlocks."""
