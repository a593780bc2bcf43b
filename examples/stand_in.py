"""What stands in for a camera in these examples: the simulated optics, under the shape that your mirror reports."""

import numpy as np
import numpy.typing as npt

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs.codec import decode_mirror
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import MIRROR_STATE
from sim_camera.driver import scene


class Optics:
    """The coronagraph, the sensor and the detector of a configuration, in the place of hardware."""

    def __init__(self, config: Configuration, service: Service) -> None:
        """Listen to where the mirror is."""
        self._config = config
        self._clock = service.clock
        self._scene = scene(config)
        self._surface_nm = np.zeros((config.mirror.rows, config.mirror.columns), np.float32)
        self._index = 0
        self._start_ns = self._clock.now_ns()
        service.bus.subscribe(MIRROR_STATE, self._hear, config.mirror.name)

    def expose(self) -> tuple[npt.NDArray[np.uint16], int]:
        """Wait for the next frame; return it and when its exposure ended."""
        self._start_ns = max(self._start_ns + self._config.period_ns, self._clock.now_ns())
        self._clock.sleep_until_ns(self._start_ns)
        there, expected = self._surface_nm.shape, (self._config.mirror.rows, self._config.mirror.columns)
        if there != expected:
            raise ConfigurationError(f"the mirror has {there} actuators, mirror.rows and mirror.columns say {expected}")
        frame = self._scene.expose(self._index, self._surface_nm)
        self._index += 1
        end_ns = self._start_ns + self._config.exposure_ns
        self._clock.sleep_until_ns(end_ns)
        return frame, end_ns

    def _hear(self, sample: Sample) -> None:
        shape = decode_mirror(sample.payload)
        if shape is not None:
            self._surface_nm = shape.actuators_nm
