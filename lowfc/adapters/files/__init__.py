"""Files other than logs: calibrations, laws, maps, layouts, sensors, the twin's cache."""
