"""Fixtures, built once: the default sensor, its modes, its twins `fast`, `accurate`, `broadband`; diffraction codes."""

import importlib
import importlib.metadata
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from lowfc.adapters.files.sensors import sensor_from
from lowfc.adapters.files.twin_cache import load_or_build
from lowfc.optics.chain.band import gauss_legendre
from lowfc.optics.chain.sensor import pupil_radii
from lowfc.optics.chain.zernike import NOLLS_20, zernikes
from lowfc.optics.twin.twin import ACCURATE, FAST


@pytest.fixture(scope="session")
def sensor():
    return sensor_from()


@pytest.fixture(scope="session")
def modes(sensor):
    """The 20 Zernike modes (20, 512, 512), of unit rms, at the pupil's samples."""
    return zernikes(NOLLS_20, *pupil_radii(sensor))


@pytest.fixture(scope="session")
def coefficients_nm():
    """Modes (20 wavefronts, 20), nm rms; the paper's bounds are 0.04 waves for radial degrees 1 and 2, 0.016 above."""
    bounds_nm = 550.0 * np.where(np.array(NOLLS_20) <= 6, 0.04, 0.016)
    return np.random.default_rng(20).uniform(-1, 1, (20, 20)) * bounds_nm


@pytest.fixture(scope="session")
def fast(sensor):
    return load_or_build(sensor, FAST)


@pytest.fixture(scope="session")
def accurate(sensor):
    return load_or_build(sensor, ACCURATE)


@pytest.fixture(scope="session")
def broadband(sensor):
    return load_or_build(sensor, FAST, gauss_legendre(550.0))


@pytest.fixture(scope="session")
def hcipy():
    """hcipy, an independent diffraction code; the warnings of its import are suppressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module("hcipy")


@pytest.fixture(scope="session")
def prysm():
    """prysm, another independent diffraction code; version 0.21 imports pkg_resources, which setuptools has dropped."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stand_in = SimpleNamespace(get_distribution=importlib.metadata.distribution)
        patch.setitem(sys.modules, "pkg_resources", stand_in)
        return importlib.import_module("prysm.propagation")
