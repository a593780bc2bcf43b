"""`lowfc export`: write a log as files for other tools."""
