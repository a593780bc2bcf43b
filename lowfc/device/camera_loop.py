"""A camera's process: publishes the frames and settings of its driver."""

import numpy as np

from lowfc.adapters.process.realtime import yield_to_sender
from lowfc.adapters.process.service import Service
from lowfc.arrays import Pixels
from lowfc.contract.envelope import COUNT_BITS
from lowfc.contract.messages import CAMERA_STATE, FRAME, image, wire
from lowfc.device.driver import Camera, CameraExtras, CameraSettings, Exposure, camera_state
from lowfc.device.watch import DriverWatch, opening

WAIT_S = 30.0
"""Longest time for which the first frame waits for the processes that need it."""
SETTINGS_NS = round(1e9 / float(CAMERA_STATE.rate))
"""Period of the published settings, and of the events on lost frames."""
PATIENCE_S = 1.0
"""Timeout of an exposure, or three periods if that is longer."""
REST_NS = 100_000_000
"""Longest sleep between two heartbeats of the process (`beat`) while a failed driver is not called."""
MAX_END_AHEAD_NS = 5_000_000
"""Largest time by which the stated end of an exposure may be ahead of the present time of its clock."""
MAX_LOST_FRAMES, MAX_RATE_RATIO = 100, 4
"""Largest plausible step of frame numbers: MAX_LOST_FRAMES + MAX_RATE_RATIO x periods since the last frame. A
larger step is a restart."""
FRAME_ID = "lowfc_camera"

_NO_EXTRAS = CameraExtras()


class CameraLoop:
    """Publishes a driver's frames until it is stopped, or for a number of frames."""

    def __init__(self, driver: Camera, service: Service, frames: int | None = None) -> None:
        """Declare the publishers on the bus and publish the first settings."""
        self._driver = driver
        self._service = service
        self._limit = frames
        getattr(driver, "join", _NO_EXTRAS.join)(service)
        self._frames = service.publisher(FRAME)
        self._puts = getattr(driver, "through", _NO_EXTRAS.through)(self._frames)
        self._states = service.publisher(CAMERA_STATE)
        self._sent = getattr(driver, "sent", _NO_EXTRAS.sent)
        self._fill_extra = getattr(driver, "fill", _NO_EXTRAS.fill)
        self._first_put_ns = self._last_put_ns = 0
        self._number: int | None = None
        self._number_ns = self._lost = self._lost_due_ns = 0
        self.watch = DriverWatch(service, PATIENCE_S)
        self._settings: CameraSettings | None = None
        self._settings_due_ns = self._settings_asked_ns = 0
        self._publish_settings()
        self._settings_due_ns = 0  # publish them again with the first frame
        service.fill = self._fill
        service.state = "ready"

    def run(self, wait_for: tuple[str, ...] = ()) -> None:
        """Expose and publish; the first frame waits for the named processes.

        Raises:
            BusError: a process did not appear, or did not answer in lockstep.
            LowfcError: the driver reports a fault that a user has to correct.
        """
        service = self._service
        step = getattr(self._driver, "step", _NO_EXTRAS.step) if service.clock.lockstep else _NO_EXTRAS.step
        finish = getattr(self._driver, "finish", _NO_EXTRAS.finish)
        with self.watch.until_closed(self._driver.close, self._fill_extra, finish):
            service.require(wait_for, WAIT_S, "the camera does not start")
            service.awaited = lambda: "" if service.work else "the camera's first frame"
            service.state = "running"
            with opening("the camera cannot be started"):
                getattr(self._driver, "start", _NO_EXTRAS.start)()
            while service.running and service.work != self._limit:
                frame = self._next_frame()
                if frame is not None:
                    self._publish(*frame)
                    self.watch.call(step)
                elif not service.clock.lockstep:  # in lockstep a sleep would advance the simulated time
                    left_ns = self.watch.retry_ns - service.clock.host_ns()
                    service.clock.sleep_until_ns(service.clock.now_ns() + min(left_ns, REST_NS))
                self._report_lost()
                service.beat()
        self._lost_due_ns = 0  # also report the frames lost in the last half second
        self._report_lost()
        service.finish()

    def _next_frame(self) -> tuple[Pixels, int] | None:
        """Pixels of the next exposure, and its end by the run's clock; None if there is no frame."""
        clock, watch = self._service.clock, self.watch
        if clock.host_ns() < watch.retry_ns:
            return None
        watch.begin()
        try:
            settings = self._publish_settings()
            exposure = self._driver.expose()
            watch.returned()
            if exposure is None:
                return None
            if not isinstance(exposure, Exposure):
                raise TypeError(f"expose() returned {type(exposure).__name__}, expected Exposure or None")
            if not isinstance(pixels := exposure.pixels, np.ndarray):
                raise TypeError(f"pixels of Exposure are {type(pixels).__name__}, expected a numpy array")
            if pixels.shape != (settings.rows, settings.columns):
                settings = self._publish_settings()  # the region changed during the exposure
            shape = settings.rows, settings.columns
            if pixels.dtype != np.uint16 or pixels.shape != shape:
                expected = f"expected uint16 of shape {shape}, as the settings say"
                raise ValueError(f"pixels are {pixels.dtype} of shape {pixels.shape}, {expected}")
            end_ns = self._end_ns(exposure, settings)
            self._follow_numbers(exposure, settings)
        except (Exception, SystemExit) as fault:
            watch.failed(fault)
            return None
        watch.worked()
        return pixels, end_ns

    def _publish(self, pixels: Pixels, end_ns: int) -> None:
        payload = image(pixels, end_ns, FRAME_ID).SerializeToString()
        if self._simulated:
            self._service.clock.sleep_until_ns(end_ns)
        envelope = self._puts.put(payload)
        yield_to_sender()
        self.watch.call(self._sent, envelope)
        self._last_put_ns = envelope.publish_time_ns
        self._first_put_ns = self._first_put_ns or envelope.publish_time_ns
        self._service.work += 1

    def _end_ns(self, exposure: Exposure, settings: CameraSettings) -> int:
        """End of an exposure by the run's clock.

        ValueError if the driver's time is over `MAX_END_AHEAD_NS` ahead, or before 1970, unless it is simulated.
        """
        clock = self._service.clock
        if exposure.end_ns is None:
            return clock.now_ns()
        end_ns = int(exposure.end_ns)
        if self._simulated:
            return end_ns
        end_ns += clock.offset_ns if settings.clock == "monotonic" else clock.ahead_ns()
        ahead_ns = end_ns - clock.host_ns()
        if ahead_ns > MAX_END_AHEAD_NS or end_ns < 0:
            expected = f"expected at most {MAX_END_AHEAD_NS * 1e-9:g} s, and a time after 1970"
            raise ValueError(f"end_ns is {ahead_ns * 1e-9:.3f} s ahead of the {settings.clock} clock, {expected}")
        return end_ns

    def _follow_numbers(self, exposure: Exposure, settings: CameraSettings) -> None:
        """Count frames that the camera lost; restart the publisher if the camera's numbers restart.

        ValueError if the number is that of the last frame, or if `lost` is no possible number of frames.
        """
        lost, now_ns = int(exposure.lost), self._service.clock.host_ns()
        if not 0 <= lost < 1 << COUNT_BITS:
            raise ValueError(
                f"lost is {lost}, expected the number of frames lost before this one, below 2^{COUNT_BITS}"
            )
        number = None if exposure.number is None else int(exposure.number)  # a numpy integer could overflow
        if number is not None and self._number is not None:
            step = (number - self._number) % int(settings.number_wrap)
            if step == 0:
                raise ValueError(f"it returned two frames with the number {number}")
            max_step = MAX_LOST_FRAMES + MAX_RATE_RATIO * (now_ns - self._number_ns) // int(settings.period_ns)
            if step > max_step:  # a restart: the controller then waits for the settings
                self._service.bus.restart()
                self._settings = None
                self._publish_settings()
            else:
                lost += step - 1
        self._number, self._number_ns = number, now_ns
        if lost:
            self._frames.published += lost
            self._frames.skipped += lost
            self._lost += lost

    def _report_lost(self) -> None:
        """Report lost frames in an event, at most one per half second."""
        now_ns = self._service.clock.host_ns()
        if self._lost and now_ns >= self._lost_due_ns:
            self._service.event("FRAMES_LOST", count=self._lost)
            self._lost, self._lost_due_ns = 0, now_ns + SETTINGS_NS

    def _publish_settings(self) -> CameraSettings:
        """Publish the settings when they have changed, and twice a second."""
        settings = self._driver.settings()
        if not isinstance(settings, CameraSettings):
            raise TypeError(f"settings() returned {type(settings).__name__}, expected CameraSettings")
        time_ns = self._service.clock.now_ns() if settings.time_ns is None else settings.time_ns
        # Estimated time until the next call.
        step_ns = min(int(settings.period_ns), SETTINGS_NS, time_ns - self._settings_asked_ns)
        self._settings_asked_ns = time_ns
        if settings != self._settings or time_ns + step_ns // 2 >= self._settings_due_ns:
            self._states.put(camera_state(settings, time_ns).SerializeToString())
            self._settings, self._settings_due_ns = settings, time_ns + SETTINGS_NS
            self._simulated = settings.clock == "run"
            self.watch.timeout_s = max(PATIENCE_S, 3e-9 * settings.period_ns)
        return settings

    def _fill(self, health: wire.Health) -> None:
        if (elapsed_ns := self._last_put_ns - self._first_put_ns) > 0:
            health.mean_rate_hz = (self._service.work - 1) * 1e9 / elapsed_ns
        self.watch.fill(self._fill_extra, health)
