"""Exports as CSV, NPZ and FITS: the table of steps, the calibration and the frames."""

import csv
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from astropy.io import fits
from astropy.table import Column as TableColumn
from astropy.table import Table

from lowfc.adapters.files.fits_file import extension, header_text, primary_hdu
from lowfc.adapters.logs.history import History
from lowfc.programs.logs.export.columns import Column, calibration_columns, step_columns
from lowfc.programs.logs.export.cubes import copy_frames_to_fits, copy_frames_to_npy

KIND = "lowfc export 1"

_ROWS_AT_ONCE = 1000


def write_csv(files: list[Path], history: History) -> None:
    """Write the steps as comma-separated values: one column for each mode, empty cells for missing values.

    Numbers have the fewest digits that reproduce the log's value in the log's precision.
    """
    columns = step_columns(history)
    noll = history.calibration.noll if history.calibration is not None else ()
    with files[0].open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow([heading for column in columns for heading in column.headings(noll)])
        for first in range(0, len(columns[0].values), _ROWS_AT_ONCE):
            cells = [_cells(column.values[first : first + _ROWS_AT_ONCE]) for column in columns]
            table.writerows(np.hstack(cells).tolist())


def write_npz(files: list[Path], history: History) -> None:
    """Write the arrays of the steps and the calibration, without pickling; the name of an array ends in its unit.

    Frames (frames, rows, columns) in DN go to the second of `files`, if given: a .npy file in the order of
    `frame_sequence`, which `numpy.load` maps with `mmap_mode="r"`.
    """
    arrays = {column.name: column.values for column in step_columns(history)}
    arrays["frame_sequence"] = history.frame_sequence
    calibration = history.calibration
    if calibration is not None:
        arrays |= {f"calibration_{one.name}": one.values for one in calibration_columns(calibration)}
        for name in ("id", "noll", "wavelength_nm", "flux_dn", "saturation_dn", "estimator"):
            arrays[f"calibration_{name}"] = np.array(getattr(calibration, name))
    if history.configuration is not None:
        arrays["configuration_toml"] = np.array(history.configuration.to_toml())
    arrays["metadata_json"] = np.array(json.dumps(history.log.metadata))
    table, *cubes = files
    with zipfile.ZipFile(table, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(values), allow_pickle=False)
    for cube in cubes:
        copy_frames_to_npy(cube, history)


def write_fits(files: list[Path], history: History, *, with_frames: bool) -> None:
    """Write the steps as table STEPS, each array of the calibration as an image, frames as FRAMES and FRAME_TIMES."""
    arrays = calibration_columns(history.calibration) if history.calibration is not None else ()
    hdus = [
        _primary(history),
        _table("STEPS", step_columns(history)),
        *(extension(one.name, one.values, one.description, one.unit or None) for one in arrays),
    ]
    fits.HDUList(hdus).writeto(files[0], overwrite=True, checksum=True)
    if not with_frames:
        return
    cube = fits.ImageHDU(np.zeros((1, 1, 1), np.float32), name="FRAMES")
    cube.header["BUNIT"] = "adu"
    copied = copy_frames_to_fits(files[0], cube, history)
    frame_times = [
        Column("sequence", copied.values("sequence"), "", "frame sequence"),
        Column("time_ns", copied.values("time_ns"), "ns", "end of the exposure, since 1970-01-01 UTC"),
    ]
    with fits.open(files[0], mode="append") as file:
        file.append(_table("FRAME_TIMES", frame_times))


def _cells(values: npt.NDArray[Any]) -> npt.NDArray[np.str_]:
    text = values.astype(str).reshape(len(values), -1)
    if values.dtype.kind == "f":
        text[~np.isfinite(values).reshape(text.shape)] = ""
    return text


def _primary(history: History) -> fits.PrimaryHDU:
    primary = primary_hdu(KIND)
    header = primary.header
    header["LOG"] = header_text(history.log.path.name)
    header["RATE"] = (history.rate_hz, "[Hz] frame rate")
    if history.calibration is not None:
        header["CALID"] = history.calibration.id
        header["NOLL"] = " ".join(map(str, history.calibration.noll))
        header["WAVELEN"] = (history.calibration.wavelength_nm, "[nm] wavelength")
        header["FLUX"] = (history.calibration.flux_dn, "[adu] expected sum of the good pixels")
    lines = [f"{name}: {key} = {value}" for name, group in history.log.metadata.items() for key, value in group.items()]
    if history.configuration is not None:
        lines += ["configuration:", *history.configuration.to_toml().splitlines()]
    for line in lines:
        header.add_comment(header_text(line))
    return primary


def _table(name: str, columns: list[Column]) -> fits.BinTableHDU:
    rows = Table()
    for column in columns:
        values = column.values
        if values.dtype.kind == "M":
            values = np.datetime_as_string(values)
        elif values.dtype == np.uint64:
            values = values.astype(np.int64)  # FITS has no uint64; a start in seconds << 32 fits in int64 until 2038
        rows[column.name] = TableColumn(values, unit=column.unit or None)
    hdu = fits.table_to_hdu(rows)
    hdu.name = name
    for number, column in enumerate(columns, 1):
        hdu.header.set(f"TCOMM{number}", column.description)
    return hdu
