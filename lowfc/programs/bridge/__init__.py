"""`lowfc bridge`: a run beside other control systems."""
