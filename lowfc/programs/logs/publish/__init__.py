"""`lowfc publish`: republish a log on the bus, at the recorded speed or another."""
