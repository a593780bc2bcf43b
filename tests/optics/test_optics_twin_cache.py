"""The cache of twins, fitted mirrors and contrast forms."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from lowfc.adapters.files import twin_cache
from lowfc.adapters.files.twin_cache import (
    default_cache_dir,
    load_or_build,
    load_or_compute_form,
    load_or_fit_mirror,
    operator_hash,
)
from lowfc.optics.chain.band import gauss_legendre, monochromatic
from lowfc.optics.chain.coronagraph import Coronagraph, LyotStop, Wedge
from lowfc.optics.chain.mirror import Mirror
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.twin.twin import Evaluator, TwinSpec

SMALL = TwinSpec(nodes=16, order=4, rank=40, guards=4)  # a coarse twin: only the cache file is tested
HASH_OF_ONES = "a4449a9f81f26403e8a1f5dda2c0cbe7385184dc0b31b34b2b78eb5a92ba3eec"


@pytest.fixture(scope="module")
def sensor(sensor):
    """The default sensor with a coarse pupil, of which twins are built fast."""
    transmission = sensor.relay.transmission[::4, ::4]
    return replace(sensor, pupil=sensor.pupil[::4, ::4], relay=ApertureMask(transmission))


@pytest.fixture(scope="module")
def built(sensor, tmp_path_factory):
    folder = tmp_path_factory.mktemp("built")
    twin = load_or_build(sensor, SMALL, cache_dir=folder)
    (path,) = folder.iterdir()
    return twin, path


@pytest.fixture
def stored(built, tmp_path):
    twin, path = built
    return twin, Path(shutil.copy(path, tmp_path))


def assert_same(first, second):
    wavefront = np.linspace(-20, 20, first.used.size, dtype=np.float32)
    np.testing.assert_array_equal(Evaluator(first).image(wavefront), Evaluator(second).image(wavefront))
    np.testing.assert_array_equal(first.area_weights, second.area_weights)
    assert first.operator_hash == second.operator_hash


def not_expected(*_):
    raise AssertionError("built again, or a file was reported")


def test_broadband_twins_are_read_back_unchanged(sensor, tmp_path):
    band = gauss_legendre(550.0, count=2)
    built = load_or_build(sensor, SMALL, band, cache_dir=tmp_path)
    again = load_or_build(sensor, SMALL, band, cache_dir=tmp_path, progress=not_expected, notice=not_expected)
    assert_same(built, again)
    assert again.operator_hash == operator_hash(sensor, SMALL, band)
    assert [each.weight for each in again.operators] == list(band.weights)


def test_operator_hash_depends_on_every_input(sensor):
    band = monochromatic(550.0)
    changed_pupil = sensor.pupil.copy()
    changed_pupil[64, 64] += 1e-6
    variants = [
        (sensor, SMALL, band),
        (replace(sensor, pupil=changed_pupil), SMALL, band),
        (replace(sensor, relay=ApertureMask(sensor.relay.transmission.T)), SMALL, band),
        (replace(sensor, focal_mask=sensor.focal_mask[1:-1, 1:-1]), SMALL, band),
        (replace(sensor, wavelength_nm=551.0), SMALL, band),
        (replace(sensor, pixels=78), SMALL, band),
        (replace(sensor, samples_per=9), SMALL, band),
        (replace(sensor, binning=1), SMALL, band),
        (sensor, replace(SMALL, nodes=18), band),
        (sensor, replace(SMALL, order=6), band),
        (sensor, replace(SMALL, rank=41), band),
        (sensor, replace(SMALL, guards=5), band),
        (sensor, SMALL, gauss_legendre(550.0)),
        (sensor, SMALL, monochromatic(550.1)),
    ]
    hashes = [operator_hash(*variant) for variant in variants]
    assert len(set(hashes)) == len(variants)
    assert operator_hash(replace(sensor), SMALL, band) == hashes[0]


def test_operator_hash_has_not_changed_since_the_first_release(sensor):
    """The hash is part of the identity of computed calibrations. Arrays of ones have the same bits on all hosts."""
    ones = np.ones((512, 512))
    plain = replace(sensor, pupil=ones, focal_mask=np.ones_like(sensor.focal_mask), relay=ApertureMask(ones))
    assert operator_hash(plain, SMALL, monochromatic(550.0)) == HASH_OF_ONES


def test_changed_source_code_rebuilds_the_cache(sensor, stored, tmp_path, monkeypatch):
    twin, mirror = stored[0], Mirror(rows=6, columns=5, pitches_per_pupil=4.0)
    load_or_fit_mirror(sensor, twin, mirror, tmp_path)
    before = set(tmp_path.iterdir())
    monkeypatch.setattr(twin_cache, "source_hash", lambda: "of another version")
    assert_same(twin, load_or_build(sensor, SMALL, cache_dir=tmp_path))
    load_or_fit_mirror(sensor, twin, mirror, tmp_path)
    assert sorted(path.name.partition("-")[0] for path in set(tmp_path.iterdir()) - before) == ["mirror", "twin"]


def test_tests_use_their_own_cache():
    assert default_cache_dir().is_relative_to(Path(__file__).parents[2] / ".pytest_cache")


def test_damaged_file_is_reported_and_rebuilt(sensor, stored, tmp_path):
    twin, path = stored
    content = path.read_bytes()
    damaged_byte = len(content) // 3
    load_or_build(sensor, replace(SMALL, rank=41), cache_dir=tmp_path / "other")
    (other,) = (tmp_path / "other").iterdir()
    for damaged in (
        content[: len(content) // 2],
        b"",
        content[:damaged_byte] + bytes([content[damaged_byte] ^ 1]) + content[damaged_byte + 1 :],
        other.read_bytes(),  # a valid file of another twin
    ):
        path.write_bytes(damaged)
        progress, notices = Mock(), []
        again = load_or_build(sensor, SMALL, progress=progress, cache_dir=tmp_path, notice=notices.append)
        (notice,) = notices
        assert str(path) in notice
        progress.assert_called_with(32, 32)
        assert_same(twin, again)
        assert_same(twin, load_or_build(sensor, SMALL, cache_dir=tmp_path, progress=not_expected, notice=not_expected))


def test_a_twin_is_built_even_if_its_cache_directory_cannot_be_written(sensor, stored, tmp_path):
    file = tmp_path / "file"
    file.write_text("not a directory")
    notices = []
    twin = load_or_build(sensor, SMALL, cache_dir=file / "cache", notice=notices.append)
    assert_same(stored[0], twin)
    assert any("cannot be written" in text for text in notices)


def test_concurrent_builds_give_one_valid_file(sensor, tmp_path):
    with ThreadPoolExecutor(2) as pool:
        twins = list(pool.map(lambda _: load_or_build(sensor, SMALL, cache_dir=tmp_path), range(2)))
    assert_same(*twins)
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]
    assert_same(twins[0], load_or_build(sensor, SMALL, cache_dir=tmp_path, progress=not_expected, notice=not_expected))


def test_the_cache_is_in_the_users_xdg_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "lowfc"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / ".cache" / "lowfc"


def test_mirror_is_cached_and_a_damaged_file_is_refitted(stored, sensor, tmp_path):
    twin, mirror, notices = stored[0], Mirror(rows=6, columns=5, pitches_per_pupil=4.0), []
    first = load_or_fit_mirror(sensor, twin, mirror, tmp_path, notices.append)
    file = next(tmp_path.glob("mirror-*.npz"))
    written = file.stat().st_mtime_ns
    again = load_or_fit_mirror(sensor, twin, mirror, tmp_path, notices.append)
    assert file.stat().st_mtime_ns == written
    assert not notices
    file.write_bytes(file.read_bytes()[:-100])
    rebuilt = load_or_fit_mirror(sensor, twin, mirror, tmp_path, notices.append)
    assert "cannot be used" in notices[0]
    for other in (again, rebuilt):
        for part in ("used", "y_factors", "x_factors", "reduce", "expand"):
            np.testing.assert_array_equal(getattr(first, part), getattr(other, part))


def test_contrast_forms_are_read_back_unchanged_and_depend_on_every_input(tmp_path, monkeypatch):
    pupil, mask = np.ones((16, 16)), np.eye(32)
    lyot = LyotStop(mask, pupil)
    other_mask, other_stop = LyotStop(np.tri(32), pupil), LyotStop(mask, np.tri(16))
    optics = Coronagraph(pupil, Wedge(), lyot), (2, 3), 550.0
    variants = [
        optics,
        (replace(optics[0], pupil=np.tri(16)), (2, 3), 550.0),
        (replace(optics[0], dark_zone=Wedge(outer=8.0)), (2, 3), 550.0),
        (replace(optics[0], lyot=None), (2, 3), 550.0),
        *((replace(optics[0], lyot=one), (2, 3), 550.0) for one in (other_mask, other_stop)),
        (replace(optics[0], lyot=replace(lyot, samples_per=4)), (2, 3), 550.0),
        (optics[0], (3, 2), 550.0),
        (optics[0], (2, 3), 551.0),
    ]
    forms = [load_or_compute_form(*each, cache_dir=tmp_path) for each in variants]
    monkeypatch.setattr(twin_cache, "contrast_form", not_expected)
    for each, form in zip(variants, forms, strict=True):
        np.testing.assert_array_equal(load_or_compute_form(*each, cache_dir=tmp_path, notice=not_expected), form)
    assert len({form.tobytes() for form in forms}) == len(variants)
