"""Python imports this at the start of every process of a run: it changes what LOWFC_ROAD names before anything else."""

import os
import sys
import traceback

_NAME = os.environ.get("LOWFC_ROAD")

if _NAME:
    try:
        from benchmarks.road.patches import apply

        apply(_NAME)
    except BaseException:  # Python itself would go on without, and the loop as it is would be measured
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
