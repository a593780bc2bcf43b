"""All chaos cases by name, in the order of the table."""

from lowfc.programs.reliability.chaos import control, disk, frames, junk, processes
from lowfc.programs.reliability.chaos.case import REGISTERED

GROUPS = ("frames", "processes", "bus", "mirror", "control", "disk", "operator")
MODULES = (frames, processes, junk, control, disk)
"""Which register the cases."""

CASES = dict(sorted(REGISTERED.items(), key=lambda item: GROUPS.index(item[1].group)))
