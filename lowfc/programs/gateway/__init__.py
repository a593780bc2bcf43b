"""`lowfc gateway`: serve a loop to a control system, and publish that system's variables on the bus for interlocks."""
