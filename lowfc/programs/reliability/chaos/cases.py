"""All chaos cases by name."""

from lowfc.programs.reliability.chaos import control, disk, frames, junk, processes
from lowfc.programs.reliability.chaos.case import REGISTERED

MODULES = (frames, processes, junk, control, disk)
"""Which register the cases."""
CASES = REGISTERED
