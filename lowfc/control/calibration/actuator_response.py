"""What the sensor sees of each actuator, in modes: Z = R H_actuators."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import normalise_flux

CHUNK = 128
"""Shapes whose responses are held at a time: 128 of 6400 pixels are 6.6 MB."""


def actuators_to_modes(
    reconstructor: Array,
    reference: Array,
    good: Array,
    response: Callable[[Array], Array],
    wavefronts: npt.NDArray[np.floating],
) -> Array:
    """Z (modes, actuators): nm of wavefront that R measures per nm of surface of each actuator.

    The image's slope is linear in the wavefront, so that it is computed for each node of the pupil where these are
    fewer than the actuators.

    Args:
        reconstructor: (modes, pixels) R, nm per flux fraction.
        reference: (pixels,) I0, in whatever unit `response` has.
        good: (pixels,) 1 where a pixel is used, else 0.
        response: Slopes (pixels, shapes) of the image per unit of each of some wavefronts (shapes, nodes), as
            `optics.twin.response` of a twin.
        wavefronts: (actuators, nodes) wavefront in nm per nm of surface of each actuator; it contains the factor 2.
    """
    actuators, nodes = wavefronts.shape
    shapes = np.eye(nodes) if nodes < actuators else np.asarray(wavefronts, dtype=np.float64)
    seen = np.empty((len(reconstructor), len(shapes)))
    for start in range(0, len(shapes), CHUNK):
        chunk = slice(start, start + CHUNK)
        seen[:, chunk] = reconstructor @ normalise_flux(reference, response(shapes[chunk]), good)[1]
    return np.asarray(seen @ wavefronts.T) if nodes < actuators else seen
