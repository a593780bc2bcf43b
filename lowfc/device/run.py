"""Run a camera or mirror driver as a process of a run; parts of the drivers' command line."""

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.process.join import join, join_beside
from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import Role
from lowfc.device.camera_loop import CameraLoop
from lowfc.device.driver import Camera, CameraExtras, Mirror, own_method
from lowfc.device.mirror_loop import MirrorLoop
from lowfc.device.plugins import Kind, load, options_help
from lowfc.device.watch import closed_on_fault, opening


def driver_command(kind: Kind, name: str | None = None) -> type[TyperCommand]:
    """Make a command class whose help lists the options of the driver `name`; default: the argument `driver`."""

    class WithOptions(TyperCommand):
        driver = name

        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            self.driver = name or self.make_parser(ctx).parse_args([*args])[0].get("driver")
            return super().parse_args(ctx, args)

        def format_options(self, ctx: Any, formatter: Any) -> None:
            super().format_options(ctx, formatter)
            own = {option for parameter in self.params for option in parameter.opts}  # the driver receives all others
            rows = options_help(load(kind, self.driver)) if self.driver else []
            rows = [row for row in rows if row[0].split()[0] not in own]
            if rows:
                with formatter.section(f"Options of the driver {self.driver}"):
                    formatter.write_dl(rows)

    return WithOptions


PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": ["-h", "--help"]}
"""Settings of a command that passes unknown arguments to the driver as its options."""
Frames = Annotated[int | None, typer.Option(min=1, help="Stop after this many frames; default: at Ctrl-C or SIGTERM.")]
LEAVE_S = 2.0
"""Longest time for which an ending controller waits until the camera in its process has ended."""
WaitFor = Annotated[
    list[str] | None, typer.Option(help="Process that the first frame waits for, up to 30 s; may be repeated.")
]


def run_camera(
    driver: Camera, config: Configuration, run: str, frames: int | None = None, wait_for: tuple[str, ...] = ()
) -> None:
    """Join a run and publish the driver's frames until SIGTERM or Ctrl-C, or for a number of frames.

    Args:
        driver: driver of the camera.
        config: configuration of the run.
        run: name of the run.
        frames: number of frames after which the camera stops; None: no limit.
        wait_for: processes that the first frame waits for.

    Raises:
        BusError: the run has a camera already, or one of `wait_for` did not appear.
        ConfigurationError: the driver cannot be started; or the run is in lockstep, and the driver has no `step`.
        DataFileError: the run's directory is damaged; or the run has a router, and this host no valid certificate.
        LowfcError: the driver reported a fault that a user has to correct.
    """
    with closed_on_fault(driver.close):
        if config.lockstep and own_method(driver, "step", CameraExtras.step) is None:
            raise ConfigurationError(
                "in lockstep a camera waits for the mirror after each frame, and this driver has no method `step` that "
                "does so; leave out lockstep"
            )
        service = join(config, run, Role.CAMERA, config.realtime.camera_cpus)
    with closing(service.bus):  # a callback on zenoh's threads must not outlive the interpreter
        with closed_on_fault(driver.close), opening("the camera cannot be started"):
            loop = CameraLoop(driver, service, frames)
        service.catch_signals()
        loop.run(wait_for)


@contextmanager
def camera_beside(driver: Camera, config: Configuration, service: Service) -> Iterator[None]:
    """Run a camera in the controller's process: the thread that reads a frame also computes the command.

    Other processes see the same role, topics and Health as from a camera in its own process. When the camera or the
    controller ends, so does the other.

    Args:
        driver: driver of the camera.
        config: configuration of the run.
        service: the controller's service, which has subscribed to frames.

    Raises:
        BusError: the run has a camera already.
        ConfigurationError: the run is in lockstep, or the driver cannot be started.
        LowfcError: the driver reported a fault that a user has to correct; raised after the block.
    """
    if config.lockstep:
        raise ConfigurationError("in lockstep the camera is a process of its own: leave out --camera, or lockstep")
    with closed_on_fault(driver.close):
        camera = join_beside(config, service, Role.CAMERA)
    faults: list[Exception] = []
    with closing(camera.bus):
        with closed_on_fault(driver.close), opening("the camera cannot be started"):
            loop = CameraLoop(driver, camera)

        def read() -> None:
            try:
                loop.run()
            except Exception as fault:
                faults.append(fault)
            finally:
                service.stop("its camera has ended")

        reading = threading.Thread(target=read, name="camera", daemon=True)
        service.on_stop(lambda: camera.stop(service.why))
        reading.start()
        try:
            yield
        finally:
            service.stop(service.why)
            reading.join(LEAVE_S)
    if faults:
        raise faults[0]


def run_mirror(driver: Mirror, config: Configuration, run: str) -> None:
    """Join a run and apply the run's commands with the driver until SIGTERM or Ctrl-C; arguments as in `run_camera`.

    Raises:
        BusError: the run has this mirror already.
        DataFileError: as in `run_camera`.
        ConfigurationError: the driver's grid or limits do not fit [mirror], or the driver cannot be started.
        LowfcError: the driver reported a fault that a user has to correct.
    """
    with closed_on_fault(driver.close):
        service = join(config, run, mirror_role(config.mirror.name), config.realtime.mirror_cpus)
    with closing(service.bus):
        with closed_on_fault(driver.close), opening("the mirror cannot be started"):
            loop = MirrorLoop(driver, service, config)
        service.catch_signals()
        loop.run()
