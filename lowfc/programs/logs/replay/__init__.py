"""`lowfc replay`: repeat a log through the controller's function and compare every result."""
