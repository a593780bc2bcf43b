"""Emulation of a CACAO bench: the simulated camera's frames in a stream, and a mirror with DM channels.

A program outside the run, with a configuration file and a folder of streams as arguments. It writes frames to
`camnsv`. It writes the sum of the existing channels dm00disp00 to dm00disp11, minus the mean, to `dm00disp`, and
applies it to the optics. It executes lines of standard input between two frames: `renew` and `region` recreate the
camera's stream, `die` ends the program in the middle of an image, `stop` prints the frame count and the residual, and
ends the program.
"""

import json
import os
import select
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.realtime import set_up, yield_to_sender
from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import load
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.messages import MIRROR_STATE, timestamp, wire
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_camera.driver import SimulatedCamera
from tests.support.image_streams.plain import FLOAT32, UINT16, PlainStream, file_of

CAMERA, TOTAL = "camnsv", "dm00disp"
REGION = 2
"""Number of rows omitted by the smaller region."""


class Comb:
    """Thread that sums the channels, like CACAO's DM comb process."""

    def __init__(self, folder: Path, rows: int, columns: int, publish: Callable[[np.ndarray], None]) -> None:
        """Create the sum and the first channel; other channels are found once they exist."""
        self.shape = (columns, rows)
        self.folder, self.publish = folder, publish
        self.total = PlainStream.make(file_of(folder, TOTAL), *self.shape, FLOAT32)
        self.channels: dict[str, PlainStream] = {}
        self.counts: dict[str, int] = {}
        self.running = True
        PlainStream.make(file_of(folder, f"{TOTAL}00"), *self.shape, FLOAT32)
        threading.Thread(target=self.run, daemon=True).start()

    def find_channels(self) -> None:
        for index in range(12):
            path = file_of(self.folder, f"{TOTAL}{index:02d}")
            if path.name not in self.channels and path.exists():
                self.channels[path.name] = PlainStream(path, *self.shape, FLOAT32)
                self.channels[path.name].reserve_semaphore(0)

    def run(self) -> None:
        """Wait for the loop's channel; update the sum whenever a channel was written."""
        searched_s = 0.0
        while self.running:
            if time.monotonic() - searched_s > 0.2:
                self.find_channels()
                searched_s = time.monotonic()
            busiest = max(self.channels.values(), key=lambda one: one.count)  # the loop's channel
            busiest.wait(0, 0.01)
            counts = {name: one.count for name, one in self.channels.items()}
            if counts != self.counts:
                self.counts = counts
                total = np.sum([one.pixels[0] for one in self.channels.values()], axis=0)
                total -= total.mean()
                self.total.write(total)
                self.publish(total * 1000)  # channels are in um


def main() -> None:
    config, folder = load(Path(sys.argv[1])), Path(sys.argv[2])
    sys.setswitchinterval(1e-4)
    set_up(
        config.realtime.priority or None,
        set(config.realtime.camera_cpus) or None,
        lock_memory=False,
        disable_cpu_idle=True,
    )
    hub, clock = MemoryHub(), HostClock()
    service = Service("camera", "cacao", clock, MemoryBus(hub, "camera", clock))
    driver = SimulatedCamera(SimulatedCamera.Options(), config)
    driver.join(service)
    states = MemoryBus(hub, f"mirror-{config.mirror.name}", clock).publisher(MIRROR_STATE, config.mirror.name)

    def publish_shape(surface_nm: np.ndarray) -> None:
        state = wire.MirrorState(timestamp=timestamp(clock.now_ns()), rows=surface_nm.shape[0])
        state.columns, state.actuators = surface_nm.shape[1], surface_nm.astype("<f4").tobytes()
        states.put(state.SerializeToString())

    comb = Comb(folder, config.mirror.rows, config.mirror.columns, publish_shape)
    settings, rows = driver.settings(), driver.settings().rows
    stream = PlainStream.make(file_of(folder, CAMERA), settings.columns, rows, UINT16)
    driver.start()
    count = 0
    while True:
        exposure = driver.expose()
        clock.sleep_until_ns(exposure.end_ns)
        stream.begin(exposure.pixels[:rows])
        # The stream's times are TAI.
        ahead_ns = round(clock.ahead_ns() - (time.clock_gettime(time.CLOCK_TAI) - time.time()) * 1e9)
        stream.end(exposure.end_ns - ahead_ns)
        yield_to_sender()  # lets the loop's processes run before the truth is computed
        driver.sent(Envelope(sequence_of(clock.start_s, count), clock.host_ns()))
        count += 1
        if not select.select([sys.stdin], [], [], 0)[0]:
            continue
        command = sys.stdin.readline().strip()
        if command == "die":
            stream.begin(exposure.pixels[:rows] // 2)
            os._exit(9)
        if command in ("renew", "region"):
            rows = settings.rows - (REGION if command == "region" else 0)
            stream = PlainStream.make(file_of(folder, CAMERA), settings.columns, rows, UINT16)
        if command in ("stop", ""):
            break
    comb.running = False
    driver.finish()
    health = wire.Health()
    driver.fill(health)
    driver.close()
    print(json.dumps({"frames": count, "residual_rms_nm": health.wavefront.continuous_residual_rms_nm}))


if __name__ == "__main__":
    main()
