"""`lowfc bridge`: share a mirror with other control systems."""
