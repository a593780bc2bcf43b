"""Calibrations in FITS files are loaded without loss; damage is detected; the headers have the units."""

import io
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from lowfc.adapters.files.calibration_file import load, save, to_bytes
from lowfc.arrays import single
from lowfc.contract.codecs import calibration_codec
from lowfc.contract.errors import DataFileError
from lowfc.control.calibration.calibration import Calibration
from tests.support import toy


def calibration(flux_dn: float = 1234.5678901234) -> Calibration:
    """The calibration of `tests.support.toy` with bad pixels and noise in some arrays."""
    toy_calibration, rng = toy.calibration(), np.random.default_rng(3)
    arrays = {
        name: single(rng.standard_normal(getattr(toy_calibration, name).shape))
        for name in ("reference", "response", "dark")
    }
    good = single(rng.random(toy_calibration.good.size) > 0.2)
    return calibration_codec.with_identity(
        replace(toy_calibration, good=good, flux_dn=flux_dn, operator_hash="0a" * 32, **arrays)
    )


@pytest.mark.parametrize("flux_dn", [1234.5678901234, 0.0026589626685784786, 2.6589626685784786e-123])
def test_a_saved_calibration_is_loaded_bit_for_bit(tmp_path: Path, flux_dn: float) -> None:
    saved, path = calibration(flux_dn), tmp_path / "night.fits"
    save(saved, path)
    loaded = load(path)
    for field in fields(Calibration):
        before, after = getattr(saved, field.name), getattr(loaded, field.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            assert before.tobytes() == after.tobytes()
            assert after.dtype.isnative
        else:
            assert before == after
            assert type(before) is type(after)
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_is_fits_with_named_extensions_and_units() -> None:
    with fits.open(io.BytesIO(to_bytes(calibration(2.6589626685784786e-123)))) as hdus:
        hdus.verify("exception")
        names = {hdu.name: hdu.header.get("BUNIT") for hdu in hdus[1:]}
        assert names == {
            "REFERENCE": "",
            "RESPONSE": "nm-1",
            "RECONSTRUCTOR": "nm",
            "MASK": "",
            "DARK": "adu",
            "MODES2ACT": "",
        }
        assert hdus[0].header["NOLL"] == "2 3 4"


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "night.fits"
    content = to_bytes(calibration())
    path.write_bytes(content)
    with fits.open(path, mode="update") as hdus:
        hdus["DARK"].data[3] += 1
    with pytest.raises(DataFileError, match="damaged: the identity of its content"):
        load(path)
    card = b"ROWS    ="
    path.write_bytes(content.replace(card + b" " * 20 + b"6", card + b" " * 16 + b"1E400"))
    with pytest.raises(DataFileError, match="cannot convert float infinity to integer"):
        load(path)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataFileError, match=r"night\.fits: not a readable calibration file"):
        load(path)


def test_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "picture.fits"
    for content in (b"", b"not FITS at all" * 400):
        path.write_bytes(content)
        with pytest.raises(DataFileError, match="not a readable calibration file"):
            load(path)
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(path, overwrite=True)
    with pytest.raises(DataFileError, match="KIND"):
        load(path)
    with pytest.raises(DataFileError, match="no such calibration file"):
        load(tmp_path / "none.fits")


def test_the_identity_depends_on_every_field_but_not_on_the_start_of_the_camera() -> None:
    original = calibration()
    assert calibration_codec.with_identity(original).id == original.id
    assert len(original.id) == 64
    absent_before: dict[str, Any] = {"camera": toy.CAMERA, "actuators_to_modes": np.zeros((3, 20), np.float32)}
    for name in {field.name for field in fields(Calibration)} - {"id"}:
        value = absent_before.get(name, getattr(original, name))
        changed = value if name in absent_before else value[::-1] if isinstance(value, str | tuple) else value + 1
        assert calibration_codec.with_identity(replace(original, **{name: changed})).id != original.id, name
    cameras = toy.CAMERA, replace(toy.CAMERA, time_ns=77, start_s=8)  # another start of the same camera
    assert len({calibration_codec.with_identity(replace(original, camera=camera)).id for camera in cameras}) == 1


def test_the_matrix_from_actuators_to_modes_is_optional(tmp_path: Path) -> None:
    without_matrix, path = calibration(), tmp_path / "night.fits"
    matrix = np.arange(60, dtype=np.float32).reshape(3, 20)
    with_matrix = calibration_codec.with_identity(replace(without_matrix, actuators_to_modes=matrix))
    save(with_matrix, path)
    assert np.array_equal(load(path).actuators_to_modes, matrix)
    assert with_matrix.id != without_matrix.id
    with fits.open(path) as hdus:
        assert "ACT2MODES" in hdus
    save(without_matrix, path)
    assert load(path).actuators_to_modes.size == 0
    with fits.open(path) as hdus:
        assert "ACT2MODES" not in hdus
