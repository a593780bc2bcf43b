"""All chaos cases by name."""

from lowfc.programs.reliability.chaos import console, control, disk, frames, junk, processes
from lowfc.programs.reliability.chaos.case import REGISTERED

MODULES = (frames, processes, console, junk, control, disk)
"""Modules that register the cases."""
CASES = REGISTERED
