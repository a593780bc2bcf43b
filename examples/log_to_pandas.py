"""Read a log into pandas: a row for each step, indexed by its time; needs `pip install pandas`.

Example: python examples/log_to_pandas.py logs/20270101T220000Z.mcap
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from lowfc import LogReader, read_history


def table(path: Path) -> pd.DataFrame:
    """Modal error, pseudo-open-loop modes and command of every step, nm rms of wavefront, and the flux in DN.

    All values but the command are NaN if the frame was refused.
    """
    history = read_history(LogReader(path))
    steps, calibration = history.steps, history.calibration
    if calibration is None:
        raise SystemExit(f"{path} has no calibration: are these all files of the recording?")
    columns = {
        f"{name}_z{noll}_nm": values[:, index]
        for name, values in (("error", steps.error_nm), ("pol", steps.pol_nm), ("command", steps.command_nm))
        for index, noll in enumerate(calibration.noll)
    }
    flux_dn = np.where(np.isfinite(steps.error_nm).all(axis=1), steps.flux_dn, np.nan)  # 0 for a refused frame
    time = pd.to_datetime(steps.time_ns, unit="ns", utc=True)
    return pd.DataFrame({**columns, "flux_dn": flux_dn}, index=pd.Index(time, name="time"))


if __name__ == "__main__":
    sys.stdout.write(table(Path(sys.argv[1])).describe().T[["count", "mean", "std"]].to_string() + "\n")
