"""`lowfc publish`: republish a log on the bus, at its own pace."""
