"""A camera of your own: what `expose` returns goes to the loop. Replace `Optics` by your camera, and its settings.

Example: python examples/camera.py --run bench
"""

from contextlib import closing
from functools import partial

import typer
from stand_in import Optics

from lowfc.adapters.process.join import join
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, run_app
from lowfc.contract.messages import CAMERA_STATE, FRAME, Role, image, timestamp, wire

SETTINGS = wire.CameraState(
    gain_e_per_dn=1.0, bias_dn=100.0, read_noise_e=1.0, saturation_dn=40_100, bit_depth=16, em_gain=1.0
)
SETTINGS_PERIOD_NS = 500_000_000


def main(run: RunId = DEFAULT_RUN, config: ConfigFile = None) -> None:
    """Publish frames until it is stopped."""
    settings = configuration(config)
    service = join(settings, run, Role.CAMERA, settings.realtime.camera_cpus)  # real-time set-up, clock and bus
    service.catch_signals()
    camera = Optics(settings, service)  # your camera
    frames, states = service.publisher(FRAME), service.publisher(CAMERA_STATE)
    service.state = "running"
    due_ns = 0
    with closing(service.bus):
        while service.running:
            pixels, end_ns = camera.expose()  # (rows, columns) uint16 in DN, when its exposure ended by service.clock
            frames.put(image(pixels, end_ns, "my_camera").SerializeToString())
            service.work += 1
            if end_ns >= due_ns:
                SETTINGS.timestamp.CopyFrom(timestamp(end_ns))
                SETTINGS.rows, SETTINGS.columns = pixels.shape
                SETTINGS.exposure_ns, SETTINGS.period_ns = settings.exposure_ns, settings.period_ns
                states.put(SETTINGS.SerializeToString())
                due_ns = end_ns + SETTINGS_PERIOD_NS
            service.beat()  # Health, twice a second
        service.finish()


if __name__ == "__main__":
    run_app(partial(typer.run, main))  # a mistake is one line, not a traceback
