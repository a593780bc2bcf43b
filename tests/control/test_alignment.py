"""A sensor's geometry from its image: a computed image, laid out in a known way, is found again."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lowfc.control.calibration.alignment import Geometry, align, onto


def computed() -> np.ndarray:
    """An image that is the same after half a turn, as that of a flat wavefront is, and not its mirror image."""
    rng = np.random.default_rng(4)
    y, x = np.indices((64, 64)) - 31.5
    speckles = gaussian_filter(rng.standard_normal((64, 64)), 2.5)
    image = np.exp(-(x**2 + y**2) / 180) * (0.05 + (speckles + speckles[::-1, ::-1]) ** 2)
    return np.asarray(image / image.sum())


@pytest.mark.parametrize(
    "geometry",
    [
        Geometry(1.0, 31.5, 31.5, 0.0, 1),
        Geometry(1.13, 33.3, 41.7, 25.0, -1),
        Geometry(0.9, 30.2, 38.9, -70.0, 1),
        Geometry(1.05, 35.0, 37.0, 89.0, -1),
    ],
)
def test_the_geometry_is_found(geometry: Geometry) -> None:
    rng = np.random.default_rng(1)
    real = rng.poisson(2e6 * onto(computed(), geometry, (70, 80)) + 5).astype(float)
    found = align(real, computed())
    assert found.geometry.parity == geometry.parity
    assert found.geometry.scale == pytest.approx(geometry.scale, abs=0.003)
    assert (found.geometry.row, found.geometry.column) == pytest.approx((geometry.row, geometry.column), abs=0.05)
    turned = (found.geometry.rotation_deg - geometry.rotation_deg + 90) % 180 - 90  # half a turn it cannot tell
    assert abs(turned) < 0.2
    assert found.flux == pytest.approx(2e6, rel=0.02)
    assert found.background == pytest.approx(5, abs=0.5)
    assert found.residual < 0.1
    assert found.other_parity > 2 * found.residual


def test_half_a_turn_leaves_the_image_and_turns_the_response_round() -> None:
    geometry = Geometry(1.1, 30.0, 40.0, 20.0, -1)
    image = computed()
    other = geometry.turned()
    assert other.turned() == geometry
    assert np.allclose(onto(image, geometry, (70, 80)), onto(image, other, (70, 80)), atol=1e-9)
    slope = image - np.roll(image, 1, axis=0)
    slope = slope - slope[::-1, ::-1]
    assert np.allclose(onto(slope, geometry, (70, 80)), -onto(slope, other, (70, 80)), atol=1e-9)


def test_light_is_kept_and_many_images_are_as_one() -> None:
    image = computed()
    geometry = Geometry(1.3, 50.0, 50.0, 33.0, 1)
    assert onto(image, geometry, (100, 100)).sum() == pytest.approx(1.0, abs=0.01)
    both = onto(np.stack([image, 2 * image], axis=2), geometry, (100, 100))
    assert np.array_equal(both[..., 0], onto(image, geometry, (100, 100)))
    assert np.allclose(both[..., 1], 2 * both[..., 0])


def test_another_image_is_refused() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(ValueError, match="nothing in the image is like"):
        align(np.pad(rng.exponential(100.0, (60, 70)), 5), computed())
    with pytest.raises(ValueError, match="no light"):
        align(np.zeros((70, 80)), computed())
