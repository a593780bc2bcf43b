"""Files other than logs: calibrations, control laws, maps, layouts, sensors, the cache of digital twins."""
