"""Response of the sensor to each actuator, in modes: Z = R H_actuators."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import normalise_flux

CHUNK = 128
"""Number of shapes whose responses are in memory at a time: 128 of 6400 pixels are 6.6 MB."""


def actuators_to_modes(
    reconstructor: Array,
    reference: Array,
    good: Array,
    response: Callable[[Array], Array],
    wavefronts: npt.NDArray[np.floating],
) -> Array:
    """Z (modes, actuators): nm of wavefront that R measures per nm of surface of each actuator.

    The slope of the image is linear in the wavefront: it is computed for each node of the pupil if there are fewer
    nodes than actuators.

    Args:
        reconstructor: (modes, pixels) R, nm per flux fraction.
        reference: (pixels,) I0, in the unit of `response`.
        good: (pixels,) 1 for a used pixel, else 0.
        response: Function from wavefronts (shapes, nodes) to the slopes (pixels, shapes) of the image per unit of each,
            such as `optics.twin.response` of a twin.
        wavefronts: (actuators, nodes) wavefront in nm per nm of surface of each actuator; it contains the factor 2.
    """
    actuators, nodes = wavefronts.shape
    shapes = np.eye(nodes) if nodes < actuators else np.asarray(wavefronts, dtype=np.float64)
    seen = np.empty((len(reconstructor), len(shapes)))
    for start in range(0, len(shapes), CHUNK):
        chunk = slice(start, start + CHUNK)
        seen[:, chunk] = reconstructor @ normalise_flux(reference, response(shapes[chunk]), good)[1]
    return np.asarray(seen @ wavefronts.T) if nodes < actuators else seen
