"""A run in one process, in real time: lowfc's controller and simulated mirror, a toy sensor, and a fake recorder."""

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

from lowfc.adapters.bus.bus import Query, Sample
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import load
from lowfc.contract.messages import CAMERA_STATE, FRAME, MIRROR_STATE, RECORD_KEY, REQUEST, image, wire
from lowfc.device.driver import CameraSettings, camera_state
from tests.support.in_process_loop import ThreadedRun
from tests.support.loops import until
from tests.support.toy import GRID, SATURATION_DN, SHAPE, TOY, calibration

RUN = "toy"
CONFIG = load(
    None,
    {
        "mirror.rows": GRID[0],
        "mirror.columns": GRID[1],
        "camera.rate_hz": 50.0,
        "control.start_mode": "closed",
        "control.tilt_gain": 0.5,
        "control.gain": 0.05,
        "control.max_frame_age_ms": 5000.0,
        "control.max_identical_frames": 0,
        "control.command_timeout_ms": 5000.0,
        "control.frame_timeout_ms": 5000.0,
        "realtime.cache_warmup": False,
    },
)


class LiveRun(ThreadedRun):
    """A run whose controller, mirror and camera are threads of this process.

    Attributes:
        requests: requests as published by the controller, without `configuration`, which a console sends at its start.
        recorder_requests: names of the requests to the recorder.
    """

    def __init__(self, folder: Path) -> None:
        self.clock = HostClock()
        super().__init__(RUN, CONFIG, lambda: self.clock)
        self.requests: list[wire.Request] = []
        self.recorder_requests: list[str] = []
        monitor = self.bus("monitor")
        monitor.subscribe(REQUEST, self._add_request)
        mirror_states: list[object] = []
        monitor.subscribe(MIRROR_STATE, mirror_states.append)
        self.bus("recorder").queryable(RECORD_KEY.format(name="*"), self._record)
        self.camera = self.service("camera")
        self.frames = self.camera.publisher(FRAME)
        settings = replace(CameraSettings.configured(CONFIG, *SHAPE), saturation_dn=SATURATION_DN)
        state = camera_state(settings, self.clock.now_ns())
        self.camera.publisher(CAMERA_STATE).put(state.SerializeToString())
        camera = SimpleNamespace(run=self._expose)
        self.start(with_identity(calibration()), "a test", folder / "safe", (camera, self.camera))
        until(lambda: mirror_states)

    def _add_request(self, sample: Sample) -> None:
        request = wire.Request.FromString(sample.payload)
        if request.name != "configuration":
            self.requests.append(request)

    def _expose(self) -> None:
        self.camera.state = "running"
        while self.camera.running:
            pixels = TOY.pixels([5.0, -3.0, 2.0])
            self.frames.put(image(pixels, self.clock.now_ns(), "toy").SerializeToString())
            self.camera.work += 1
            self.camera.beat()
            time.sleep(0.02)
        self.camera.finish()

    def _record(self, query: Query) -> None:
        self.recorder_requests.append(query.name)
        answer = wire.Request(name=query.name, accepted=True, reply=f"{query.name}: night.mcap", text="night.mcap")
        query.reply(answer.SerializeToString())
