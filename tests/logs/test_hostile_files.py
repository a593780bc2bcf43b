"""Hostile files: a malformed file named on a command line or in a configuration leads to a one-line error."""

import gzip
import io
import lzma
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from astropy.io import fits

from lowfc.adapters.files import calibration_file, fits_file, law_file
from lowfc.adapters.files.array_file import read_array
from lowfc.adapters.files.layouts import load_layout
from lowfc.adapters.files.sensors import load_pupil
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import recover
from lowfc.contract.codecs import input_file
from lowfc.contract.configuration import MAX_FAULTS, load
from lowfc.contract.errors import ConfigurationError, LowfcError
from lowfc.programs.core.start_up import check_files
from lowfc.programs.design.sam_files import read_state
from lowfc.programs.logs.replay.workers import replay_files

MAX_CHARACTERS = 500
"""Longest error message, including the path of its file."""


def error_of(call: Callable[[], object]) -> str:
    with pytest.raises(LowfcError) as caught:
        call()
    text = str(caught.value)
    assert len(text) < MAX_CHARACTERS
    assert text.isprintable(), "the error has one line"
    return text


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"seed = " + b"[" * 100_000, "nested too deeply"),
        (b"seed = " + b"{a=" * 100_000, "nested too deeply"),
        (b"seed = " + b"9" * 100_000, "a number in it has too many digits"),
        (b"seed = 0x" + b"f" * 100_000, "seed = a number of too many digits: must be less than"),
        *(
            (b".".join([part] * 150_000) + b" = 1", "line 1 has more than 100 dots")
            for part in (b"a", b"1", b"10", b"1_0", b"0e-0", b"0a0")
        ),
        (b"seed = 1\n[" + b" . ".join([b"a"] * 200_000) + b"]", "line 2 has more than 100 dots"),
        (b"".join(b"a.b.c%d = 1\n" % number for number in range(200_000)), "larger than 1048576 bytes"),
        (b"".join(b"a.b.c%d = 1\n" % number for number in range(50_000)), "unknown key 'a'"),
        (b"k" * 900_000 + b" = 1", "unknown key 'kkk"),
        (b"[camera]\nrate_hz = '" + b"k" * 900_000 + b"'", "camera.rate_hz = 'kkk"),
        (b"[disturbance]\npreset = {" + b".".join([b"a"] * 90) + b" = 1}", "disturbance.preset = {'a': {'a'"),
        (b"seed = 1\n" * 2, "not a readable TOML file: Cannot overwrite a value"),
        (b"\xff\xfe", "not a readable TOML file: 'utf-8' codec can't decode"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_hostile_configuration_is_refused(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "hostile.toml"
    path.write_bytes(content)
    text = error_of(lambda: load(path))
    assert text.startswith(f"{path}: ")
    assert expected in text


def test_only_the_first_of_many_mistakes_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "hostile.toml"
    path.write_text("".join(f"k{number} = 1\n" for number in range(50_000)))
    with pytest.raises(ConfigurationError) as caught:
        load(path)
    lines = str(caught.value).splitlines()
    assert (len(lines), lines[-1]) == (MAX_FAULTS + 1, f"{path}: and {50_000 - MAX_FAULTS} more")


def test_many_dots_in_a_comment_or_a_list_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "valid.toml"
    values = ", ".join(f'"{number}" = {number}.5' for number in range(90))
    path.write_text(f"# {'.' * 1000}\n[mirror]\nstuck_nm = {{ {values} }}\n")
    assert load(path).mirror.stuck_nm["7"] == 7.5


def loop_of_links(folder: Path) -> Path:
    (folder / "a").symlink_to(folder / "b")
    (folder / "b").symlink_to(folder / "a")
    return folder / "a"


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


READERS: dict[str, Callable[[Path], object]] = {
    "toml": load,
    "json": lambda path: load_layout(str(path)),
    "npz": lambda path: load_pupil(file=path),
    "npy": lambda path: read_array(path, "an array", (2,)),
    "fits": lambda path: read_array(path, "an array", (2,)),
    "calibration.fits": calibration_file.load,
    "law.fits": law_file.load,
    "state.json": lambda path: read_state(path, "pupil"),
    "mcap": lambda path: list(LogReader(path)),
    "replay.mcap": lambda path: replay_files([path], 0.0, 1, lambda done: None),
    "recover.mcap": lambda path: recover(path, path.with_name("out.mcap")),
}


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (loop_of_links, "Too many levels of symbolic links"),
        (pipe, "not a regular file"),
        (lambda _: Path("/dev/zero"), "not a regular file"),
        (lambda folder: folder, "not a regular file"),
    ],
    ids=["loop", "pipe", "device", "directory"],
)
def test_only_regular_files_are_read(tmp_path: Path, kind: str, make: Callable[[Path], Path], expected: str) -> None:
    path = tmp_path / f"named.{kind}"
    path.symlink_to(make(tmp_path))
    text = error_of(lambda: READERS[kind](path))
    assert str(path) in text
    assert expected in text


def npy(header: bytes) -> bytes:
    """A .npy file of this header and 64 zero bytes of data."""
    header += b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)


HUGE_ARRAY = npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (4000000, 4000000), }")
"""A header of an array of 58 TiB, without the data."""


@pytest.mark.parametrize(
    ("content", "key"),
    [
        (HUGE_ARRAY, "mirror.flat"),
        (HUGE_ARRAY, "mirror.active"),
        (npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': " + b"(" * 9000 + b"}"), "mirror.flat"),
        (npy(b"(" * 9000 + b")" * 9000), "mirror.flat"),
    ],
)
def test_an_array_with_a_hostile_header_is_refused(tmp_path: Path, content: bytes, key: str) -> None:
    path = tmp_path / "hostile.npy"
    path.write_bytes(content)
    text = error_of(lambda: check_files(load(None, {key: str(path)})))
    assert text.startswith(f"{key}: {path}: neither a FITS image nor a numpy array")


def npz() -> bytes:
    content = io.BytesIO()
    np.savez(content, np.ones((34, 34)))
    return content.getvalue()


def damaged_in_the_middle(compress: Callable[[bytes], bytes]) -> bytes:
    """A compressed FITS image, with one bit changed in the middle of the file."""
    content = io.BytesIO()
    fits.PrimaryHDU(np.random.default_rng(1).normal(size=(34, 34))).writeto(content)
    damaged = bytearray(compress(content.getvalue()))
    damaged[len(damaged) // 2] ^= 0x10
    return bytes(damaged)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (npz(), "it is an archive, such as .npz"),
        (b"\x1f\x9d\x90", "it is an archive, such as .npz or .Z"),
        (b"\x1f\x8b\x08" + bytes(7) + b"\xff" * 50, "invalid block type"),
        (damaged_in_the_middle(lzma.compress), "Internal error"),
        (damaged_in_the_middle(gzip.compress), "CRC check failed"),
    ],
)
def test_archives_and_damaged_compressed_files_are_refused(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "flat.fits"
    path.write_bytes(content)
    assert expected in error_of(lambda: check_files(load(None, {"mirror.flat": str(path)})))


def test_the_unit_of_a_shape_is_checked_and_that_of_a_map_of_active_actuators_is_ignored(tmp_path: Path) -> None:
    path, image = tmp_path / "map.fits", fits.PrimaryHDU(np.ones((34, 34)))
    image.header["BUNIT"] = "um"
    image.writeto(path)
    text = error_of(lambda: check_files(load(None, {"mirror.flat": str(path)})))
    assert "its values are in um (BUNIT), expected nm" in text
    check_files(load(None, {"mirror.active": str(path)}))
    image.header["BUNIT"] = "nm"
    image.writeto(path, overwrite=True)
    check_files(load(None, {"mirror.flat": str(path)}))


def test_an_error_without_text_is_reported_by_its_class(tmp_path: Path) -> None:
    content = fits_file.to_bytes(fits_file.primary_hdu("map"), [])
    parse = Mock(side_effect=MemoryError)
    text = error_of(lambda: fits_file.load(tmp_path / "a.fits", ("map",), "map", parse, content=content))
    assert text.endswith("a.fits: not a readable map: MemoryError")


def test_fits_images_and_pupils_with_a_huge_header_are_refused(tmp_path: Path) -> None:
    cards = ("SIMPLE  = T", "BITPIX  = -32", "NAXIS   = 2", "NAXIS1  = 4000000", "NAXIS2  = 4000000", "END")
    fields = (card.partition(" = ") for card in cards)
    header = "".join(f"{name}{equals}{value:>20}".ljust(80) for name, equals, value in fields)
    image, pupil = tmp_path / "hostile.fits", tmp_path / "hostile.npz"
    image.write_bytes(header.ljust(2880).encode() + bytes(2880))
    with zipfile.ZipFile(pupil, "w") as archive:
        archive.writestr("quarter.npy", HUGE_ARRAY)
    for path, key in ((image, "mirror.flat"), (image, "control.law"), (pupil, "sensor.pupil")):
        assert str(path) in error_of(lambda path=path, key=key: check_files(load(None, {key: str(path)})))


@pytest.mark.parametrize(
    ("key", "file"),
    [
        *((key, "x.fits") for key in ("mirror.flat", "mirror.active", "control.law")),
        *(("sensor.sam", "x.json"), ("sensor.pupil", "x.npz")),
    ],
)
def test_a_file_in_the_home_of_an_unknown_user_is_reported_as_missing(key: str, file: str) -> None:
    path = f"~no-such-user/{file}"
    text = error_of(lambda: check_files(load(None, {key: path})))
    assert path in text
    assert "there is no" in text


NESTED = b"[" * 900 + b"]" * 900


@pytest.mark.parametrize(
    "content", [b"[" * 100_000, b'{"hole_diameter": 0.1, "holes": [[' + NESTED + b", 0]]}", b"9" * 100_000]
)
def test_a_hostile_layout_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "hostile.json"
    path.write_bytes(content)
    assert str(path) in error_of(lambda: load_layout(str(path)))
    assert str(path) in error_of(lambda: read_state(path, "pupil"))


def test_a_file_is_read_up_to_the_size_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert input_file.read_whole(path, 5) == b"12345"
    with pytest.raises(OSError, match="larger than 4 bytes"):
        input_file.read_whole(path, 4)
    with pytest.raises(OSError, match="larger than 4 bytes"):  # although the reported size of this file is 0
        input_file.read_whole(Path("/proc/self/status"), 4)
    before = set(Path("/proc/self/fd").iterdir())
    with pytest.raises(OSError, match="not a regular file"):
        input_file.opened(tmp_path, 5)
    assert set(Path("/proc/self/fd").iterdir()) == before
