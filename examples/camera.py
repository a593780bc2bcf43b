"""Template of a camera driver: `expose` returns frames for the loop. Replace `Optics` by your camera and its settings.

Example: lowfc camera examples/camera.py:MyCamera --run bench --config bench.toml
"""

from stand_in import Optics

from lowfc.device import CameraSettings, Configuration, DriverOptions, Exposure


class MyCamera:
    """A camera of 80 x 80 pixels."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        """Open the camera."""
        self.config = config
        self.optics = Optics(config)
        self.join = self.optics.join  # the stand-in subscribes to the mirror; a real camera does not

    def settings(self) -> CameraSettings:
        """Return the camera's settings."""
        exposure_ns, period_ns = self.config.exposure_ns, self.config.period_ns
        return CameraSettings(80, 80, exposure_ns, period_ns, bias_dn=100, read_noise_e=1, saturation_dn=40_100)

    def expose(self) -> Exposure:
        """Wait for the next frame and return it with the end of its exposure by CLOCK_MONOTONIC."""
        pixels, end_ns = self.optics.expose()
        return Exposure(pixels, end_ns)

    def close(self) -> None:
        """Release the camera."""
