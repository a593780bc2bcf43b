"""From a bench to a closed loop: calibrate, tune, acceptance tests, checks of drivers and hosts."""
