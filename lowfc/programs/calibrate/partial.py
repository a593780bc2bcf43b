"""The cycles of a calibration that was interrupted, beside its file: FILE.part.npz."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters import fits_file
from lowfc.adapters.whole_file import write_whole
from lowfc.contract.errors import DataFileError
from lowfc.control.response_fit import Initial, Sums


def partial_of(out: Path) -> Path:
    """Where the cycles done are kept until a calibration is whole."""
    return out.with_name(out.name + ".part.npz")


def keep(path: Path, sums: Sums, what: dict[str, Any]) -> None:
    """Write the cycles done, and what they are of.

    Raises:
        DataFileError: it cannot be written.
    """
    stream = io.BytesIO()
    arrays = sums._asdict() | {"initial": sums.initial.matrix, "estimator": sums.initial.estimator}
    np.savez(stream, what=np.array(json.dumps(what, sort_keys=True)), **arrays)
    write_whole(path, stream.getvalue())


def go_on(path: Path, what: dict[str, Any]) -> Sums:
    """The cycles done.

    Raises:
        DataFileError: there are none, the file is damaged, or they are of another calibration.
    """
    before, sums = begun(path)
    for key, value in what.items():
        if before.get(key) != value:
            raise DataFileError(
                f"{path} is of another calibration: its {key} is {before.get(key)}, now it is {value}; remove the "
                "file, or leave --resume out"
            )
    return sums


def begun(path: Path) -> tuple[dict[str, Any], Sums]:
    """What the cycles done are of, and these cycles.

    Raises:
        DataFileError: there are none, or the file is damaged.
    """
    if not path.is_file():
        raise DataFileError(f"there is nothing to go on from: no {path}; leave --resume out")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            sums = Sums(
                Initial(arrays["initial"], str(arrays["estimator"])),
                arrays["answers"],
                arrays["response"],
                arrays["reference"],
                int(arrays["references"]),
                float(arrays["flux_dn"]),
            )
            return dict(json.loads(str(arrays["what"]))), sums
    except (*fits_file.DAMAGED, zipfile.BadZipFile) as error:
        why = fits_file.in_a_line(error)
        raise DataFileError(f"{path} is damaged, or no part of a calibration: {why}; remove it") from None
