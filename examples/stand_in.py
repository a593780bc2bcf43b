"""Replacement for camera hardware in these examples: the simulated optics with the shape that your mirror reports."""

import time

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.codecs.codec import decode_mirror
from lowfc.contract.messages import MIRROR_STATE
from lowfc.device import Configuration, ConfigurationError, Pixels, Service
from sim_camera.driver import scene


class Optics:
    """The coronagraph, sensor and detector of a configuration, in place of hardware."""

    def __init__(self, config: Configuration) -> None:
        """Build the optics."""
        self._config = config
        self._scene = scene(config)
        self._surface_nm = np.zeros((config.mirror.rows, config.mirror.columns), np.float32)
        self._index = self._start_ns = 0

    def join(self, service: Service) -> None:
        """Subscribe to the shape of the mirror."""
        service.bus.subscribe(MIRROR_STATE, self._on_mirror_state, self._config.mirror.name)

    def expose(self) -> tuple[Pixels, int]:
        """Wait for the next frame; return it and the end of its exposure by CLOCK_MONOTONIC."""
        self._start_ns = max(self._start_ns + self._config.period_ns, time.monotonic_ns())
        _sleep_until_ns(self._start_ns)
        found, expected = self._surface_nm.shape, (self._config.mirror.rows, self._config.mirror.columns)
        if found != expected:
            raise ConfigurationError(f"the mirror has {found} actuators, mirror.rows and mirror.columns say {expected}")
        frame = self._scene.expose(self._index, self._surface_nm)
        self._index += 1
        end_ns = self._start_ns + self._config.exposure_ns
        _sleep_until_ns(end_ns)
        return frame, end_ns

    def _on_mirror_state(self, sample: Sample) -> None:
        shape = decode_mirror(sample.payload)
        if shape is not None:
            self._surface_nm = shape.actuators_nm


def _sleep_until_ns(deadline_ns: int) -> None:
    time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
