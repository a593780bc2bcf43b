"""Fixtures of the tests of the search for a sparse aperture mask."""

import pytest

from lowfc.adapters.files.sensors import load_pupil
from lowfc.design.sam_merit import Optics, build_optics


@pytest.fixture(scope="session")
def optics() -> Optics:
    """The optics before the mask, with the sampling of a search."""
    return build_optics(load_pupil(256))
