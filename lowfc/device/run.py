"""A driver's process: how it joins a run, and its command line."""

from contextlib import closing
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.process.join import join
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import Role
from lowfc.device.camera_loop import CameraLoop
from lowfc.device.driver import Camera, Mirror
from lowfc.device.mirror_loop import MirrorLoop
from lowfc.device.plugins import Kind, load, options_help
from lowfc.device.watch import opening


def command_of(kind: Kind, name: str | None = None) -> type[TyperCommand]:
    """A command whose help lists its driver's own options: of the driver of this name, or of the argument `driver`."""

    class WithOptions(TyperCommand):
        driver = name

        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            self.driver = name or self.make_parser(ctx).parse_args([*args])[0].get("driver")
            return super().parse_args(ctx, args)

        def format_options(self, ctx: Any, formatter: Any) -> None:
            super().format_options(ctx, formatter)
            rows = options_help(load(kind, self.driver)) if self.driver else []
            if rows:
                with formatter.section(f"Options of the driver {self.driver}"):
                    formatter.write_dl(rows)

    return WithOptions


PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Settings of a command that leaves words to the driver: its options."""
Frames = Annotated[int | None, typer.Option(min=1, help="Stop after so many frames; default: until Ctrl-C or SIGTERM.")]
WaitFor = Annotated[list[str] | None, typer.Option(help="Process that the first frame waits for; repeat.")]


def run_camera(
    driver: Camera, config: Configuration, run: str, frames: int | None = None, wait_for: tuple[str, ...] = ()
) -> None:
    """Join a run and publish the driver's frames until SIGTERM or Ctrl-C, or a number of them.

    Args:
        driver: of the camera.
        config: of the run.
        run: its name.
        frames: after which it stops.
        wait_for: processes that the first frame waits for.

    Raises:
        BusError: the run has a camera already, or one of `wait_for` did not come.
    """
    service = join(config, run, Role.CAMERA, config.realtime.camera_cpus)
    with opening("the camera does not say how it is set"):
        loop = CameraLoop(driver, service, config, frames)
    service.catch_signals()
    with closing(service.bus):  # a callback on zenoh's threads must not outlive the interpreter
        loop.run(wait_for)


def run_mirror(driver: Mirror, config: Configuration, run: str) -> None:
    """Join a run and have the driver follow its commands until SIGTERM or Ctrl-C; arguments as of `run_camera`.

    Raises:
        BusError: the run has this mirror already.
        ConfigurationError: the driver's grid is not that of [mirror].
    """
    service = join(config, run, mirror_role(config.mirror.name), config.realtime.mirror_cpus)
    with opening("the mirror does not say what it is"):
        loop = MirrorLoop(driver, service, config)
    service.catch_signals()
    with closing(service.bus):
        loop.run()
