"""The wavefront at which `lowfc calibrate --method analytic` computes: of modes, or of a shape of the mirror."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.adapters.mirror_maps import shape_of
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.optics.twin import Twin, node_radii
from lowfc.optics.twin_mirror import TwinMirror, wavefront_nm
from lowfc.optics.zernike import zernikes
from lowfc.programs.analytic import Wavefront


class ZeroPoint(NamedTuple):
    """A wavefront that is not flat, and its name in a calibration."""

    name: str
    wavefront: Wavefront


def zero_point(config: Configuration, text: str) -> ZeroPoint:
    """What --at asks for: modes as in 4=15,7=-10, Noll index = nm rms, or a file as `lowfc ctl channel` takes it.

    Raises:
        ConfigurationError: it is neither, or the shape does not fit the mirror.
    """
    if "=" not in text:
        shape = shape_of(config, "--at", text)
        return ZeroPoint("a shape", lambda _, mirror: wavefront_nm(mirror, shape).astype(np.float64))
    modes_nm = _modes(text)

    def of_modes(optics: Twin, _: TwinMirror) -> npt.NDArray[np.float64]:
        return np.array(list(modes_nm.values())) @ zernikes(list(modes_nm), *node_radii(optics))

    return ZeroPoint(",".join(f"{mode}={amplitude_nm:g}" for mode, amplitude_nm in modes_nm.items()), of_modes)


def _modes(text: str) -> dict[int, float]:
    found: dict[int, float] = {}
    for part in text.split(","):
        index, _, value = part.partition("=")
        try:
            mode, amplitude_nm = int(index), float(value)
        except ValueError:
            raise ConfigurationError(f"--at takes modes in nm, as in 4=15,7=-10, or a file; got {part!r}") from None
        if mode < 2 or mode in found or not np.isfinite(amplitude_nm):
            raise ConfigurationError(
                f"--at: {part!r} is not a Noll index of 2 or more, named once, and its amplitude in nm"
            )
        found[mode] = amplitude_nm
    return found
