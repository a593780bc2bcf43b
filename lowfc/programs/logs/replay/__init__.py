"""`lowfc replay`: rerun the controller's function on a log and compare every result."""
