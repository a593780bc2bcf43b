"""A camera's process: frames and settings of its driver to the bus."""

from lowfc.adapters.process.realtime import let_send
from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError
from lowfc.contract.messages import CAMERA_STATE, FRAME, image, timestamp, wire
from lowfc.device.driver import Camera, CameraExtras, CameraSettings

WAIT_S = 30.0
"""How long the first frame waits for those who must not miss it."""
SETTINGS_NS = round(1e9 / float(CAMERA_STATE.rate))
FRAME_ID = "lowfc_camera"

_IDLE = CameraExtras()


class CameraLoop:
    """Publishes a driver's frames until told to stop, or a number of them."""

    def __init__(self, driver: Camera, service: Service, config: Configuration, frames: int | None = None) -> None:
        """Declare everything on the bus; publish the first settings."""
        self._driver = driver
        self._service = service
        self._limit = frames
        getattr(driver, "join", _IDLE.join)(service)
        self._frames = service.publisher(FRAME)
        self._puts = getattr(driver, "through", _IDLE.through)(self._frames)
        self._states = service.publisher(CAMERA_STATE)
        self._sent = getattr(driver, "sent", _IDLE.sent)
        self._fill_extra = getattr(driver, "fill", _IDLE.fill)
        self._first_put_ns = self._last_put_ns = 0
        self._settings: CameraSettings | None = None
        self._due_ns = 0
        self._tell_settings()
        self._due_ns = 0
        service.fill = self._fill
        service.state = "ready"

    def run(self, wait_for: tuple[str, ...] = ()) -> None:
        """Expose and publish; the first frame waits for those named.

        Raises:
            BusError: somebody did not come, or in lockstep did not answer.
        """
        service = self._service
        missing = service.wait_for(wait_for, WAIT_S)
        if missing and service.running:
            raise BusError(f"no sign of {', '.join(missing)} after {WAIT_S:g} s; the camera will not start without")
        service.state = "running"
        getattr(self._driver, "start", _IDLE.start)()
        step = getattr(self._driver, "step", _IDLE.step) if service.clock.lockstep else _IDLE.step
        while service.running and service.work != self._limit:
            self._tell_settings()
            if self._publish_frame():
                step()
            service.beat()
        self._driver.close()
        service.finish()

    def _publish_frame(self) -> bool:
        exposure = self._driver.expose()
        if exposure is None:
            return False
        assert self._settings is not None  # noqa: S101  # told before
        clock, end_ns = self._service.clock, exposure.end_ns
        if end_ns is None:
            end_ns = clock.now_ns()
        elif self._settings.clock == "monotonic":
            end_ns += clock.offset_ns
        payload = image(exposure.pixels, end_ns, FRAME_ID).SerializeToString()
        if self._settings.clock == "run":
            clock.sleep_until_ns(end_ns)
        envelope = self._puts.put(payload)
        let_send()
        self._sent(envelope)
        self._last_put_ns = envelope.publish_time_ns
        self._first_put_ns = self._first_put_ns or envelope.publish_time_ns
        self._service.work += 1
        return True

    def _tell_settings(self) -> None:
        """Publish the settings when they have changed, and twice a second."""
        settings = self._driver.settings()
        time_ns = self._service.clock.now_ns() if settings.time_ns is None else settings.time_ns
        if settings == self._settings and time_ns + settings.period_ns // 2 < self._due_ns:
            return
        self._settings, self._due_ns = settings, time_ns + SETTINGS_NS
        self._states.put(state_of(settings, time_ns).SerializeToString())

    def _fill(self, health: wire.Health) -> None:
        if (elapsed_ns := self._last_put_ns - self._first_put_ns) > 0:
            health.mean_rate_hz = (self._frames.published - 1) * 1e9 / elapsed_ns
        self._fill_extra(health)


def state_of(settings: CameraSettings, time_ns: int) -> wire.CameraState:
    """Message of a camera's settings."""
    saturation_dn = settings.saturation_dn
    return wire.CameraState(
        timestamp=timestamp(time_ns),
        exposure_ns=settings.exposure_ns,
        period_ns=settings.period_ns,
        gain_e_per_dn=settings.gain_e_per_dn,
        bias_dn=settings.bias_dn,
        read_noise_e=settings.read_noise_e,
        saturation_dn=2**settings.bit_depth - 1 if saturation_dn is None else saturation_dn,
        region_row=settings.region_row,
        region_column=settings.region_column,
        rows=settings.rows,
        columns=settings.columns,
        bit_depth=settings.bit_depth,
        em_gain=settings.em_gain,
    )
