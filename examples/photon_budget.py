"""Electrons of one frame, and its noise in tilt and in the other modes, against V magnitude.

Example: python examples/photon_budget.py 2 5
"""

import sys
import warnings
from collections.abc import Iterator, Sequence

import numpy as np

from lowfc import Configuration
from lowfc.adapters.files import factory
from lowfc.optics.detector.photometry import tilt_nm_per_mas


def budget(magnitudes: Sequence[float]) -> Iterator[str]:
    """Yield a header and a row for each magnitude: default sensor and rate, R weighted for the star's flux."""
    config = Configuration()
    optics = factory.twin(config, None, warnings.warn)
    on_nodes = factory.mirror_on_twin(config, optics, warnings.warn)
    nm_per_mas = tilt_nm_per_mas(config.star.diameter_m)
    yield f"{config.sensor.kind}, {config.camera.rate_hz:g} frames per second: noise of one frame"
    yield "    V   electrons   tilt, mas rms per axis   other modes, nm rms per mode"
    for magnitude in magnitudes:
        with_star = config.model_copy(update={"star": config.star.model_copy(update={"magnitude": magnitude})})
        calibration = factory.analytic_calibration(with_star, optics, on_nodes)
        noise_nm = factory.frame_noise_nm(with_star, calibration)
        tilt_mas, others_nm = (np.sqrt(np.mean(part**2)) for part in (noise_nm[:2] / nm_per_mas, noise_nm[2:]))
        light_e = calibration.flux_dn * config.camera.gain_e_per_dn
        yield f"{magnitude:5.1f}   {light_e:9.0f}   {tilt_mas:22.2f}   {others_nm:28.2f}"


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in budget([float(word) for word in sys.argv[1:]]))
