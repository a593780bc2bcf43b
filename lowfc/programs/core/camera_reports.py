"""The camera's settings: received when published, and queried until they arrive after a start of either side."""

import time
from collections.abc import Callable
from dataclasses import replace

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs import codec
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import CAMERA_STATE
from lowfc.control.loop.camera import CameraSettings

LOCKSTEP_WAIT_NS = 20_000_000_000
"""Longest time that the start of a lockstep run waits for the settings."""
QUERY_PERIOD_NS = 500_000_000
"""Shortest time between two queries."""


class CameraReports:
    """The newest message of the camera's settings is in `mailbox`; `apply` passes its content to a callback."""

    def __init__(self, service: Service, apply: Callable[[CameraSettings], None]) -> None:
        self._service, self._apply = service, apply
        self.mailbox = service.mailbox(CAMERA_STATE)
        self._due_ns = 0

    def apply(self, sample: Sample, time_ns: int | None = None) -> None:
        """Decode the settings in a message and pass them to the callback, with the time `time_ns` if it is given."""
        try:
            settings = codec.decode_camera(sample.payload, start_of(sample.sequence))
        except BadMessageError as fault:
            self._service.unreadable(sample.key, fault)
            return
        self._apply(settings if time_ns is None else replace(settings, time_ns=time_ns))

    def query(self) -> list[Sample]:
        """Query the camera, which may publish its settings rarely; empty within QUERY_PERIOD_NS of the last query."""
        now_ns = self._service.clock.host_ns()
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + QUERY_PERIOD_NS
        return list(self._service.bus.get(CAMERA_STATE.key, timeout_s=0.1))

    def await_first(self) -> None:
        """Query the settings before the first frame; in lockstep wait for them, so that runs are reproducible."""
        clock = self._service.clock
        deadline_ns = clock.host_ns() + (LOCKSTEP_WAIT_NS if clock.lockstep else 0)
        while self._service.running:
            for sample in self._service.bus.get(CAMERA_STATE.key, timeout_s=0.2):
                # The clock's time, not the camera's: the answer may be the message before the first frame or the one
                # with it. Their times differ, and so would two runs.
                self.apply(sample, clock.now_ns() if clock.lockstep else None)
                return
            if clock.host_ns() >= deadline_ns:
                return
            self._service.beat()
            time.sleep(0.02)
