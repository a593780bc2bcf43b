"""What the tests of the search for a sparse aperture mask share."""

import pytest

from lowfc.adapters.files.sensors import load_pupil
from lowfc.design.sam_merit import Optics, build_optics


@pytest.fixture(scope="session")
def optics() -> Optics:
    """All that precedes the mask, as a search has it."""
    return build_optics(load_pupil(256))
