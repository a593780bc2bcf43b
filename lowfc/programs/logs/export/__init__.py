"""`lowfc export`: a log for the tools of the field."""
