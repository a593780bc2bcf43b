"""The commands of a loop's own processes: `lowfc controller` and `lowfc record`."""

import json
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, Json, RunId, configuration
from lowfc.contract.errors import ConfigurationError

_WAIT_FOR_S = 30.0


def controller(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file (FITS), or `none`; default: computed from the configuration.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="DRIVER",
            help="Run this camera driver in the controller's process; default: the camera has its own process.",
        ),
    ] = None,
    wait_for: Annotated[
        list[str] | None,
        typer.Option(help="Process to wait for, up to 30 s, before the loop starts; repeat for several."),
    ] = None,
) -> None:
    """Run the controller: frames in, mirror commands out.

    With --camera, the driver runs in the controller's process for the lowest latency; its options are in
    [drivers.DRIVER]. If the driver crashes, so does the controller.

    Example: lowfc controller --run bench --calibration calibration.fits
    """
    import signal

    from rich.console import Console

    from lowfc.adapters.bus.run import open_run
    from lowfc.adapters.files.calibration_file import load
    from lowfc.adapters.process import compiled
    from lowfc.adapters.process.join import join
    from lowfc.adapters.process.latch import Latch, latch_files
    from lowfc.contract.messages import Role
    from lowfc.control.kernel.tables import FUSED
    from lowfc.device import plugins
    from lowfc.device.run import camera_beside
    from lowfc.programs.commissioning.analytic import analytic
    from lowfc.programs.core.controller import Controller

    signalled: list[int] = []  # signals received before the controller exists
    signal.signal(signal.SIGUSR1, lambda number, _: signalled.append(number))
    settings = configuration(config)
    driver = None if camera is None else plugins.load("camera", camera)  # opened below, once nothing else can fail
    loaded = None
    if calibration is None:
        loaded = analytic(settings, Console(stderr=True))
    elif str(calibration) != "none":
        loaded = load(calibration)
    if settings.realtime.kernel == FUSED and compiled.available():
        with Console(stderr=True).status("compiling the fused step"):
            compiled.kernel(FUSED)
    service = join(settings, run, Role.CONTROLLER, settings.realtime.controller_cpus)
    service.require(wait_for or (), _WAIT_FOR_S, "the controller does not start")
    source = calibration.name if calibration is not None else "the configuration"
    latch = Latch(
        latch_files(open_run(run, (settings.mirror.name,))), lambda why: service.event("LATCH_FAILED", why=why)
    )
    process = Controller(settings, service, loaded, source, latch)
    signal.signal(signal.SIGUSR1, lambda number, _: process.safe_by_signal())
    if signalled:
        process.safe_by_signal()
    service.fill = process.fill
    service.catch_signals()
    with closing(service.bus), ExitStack() as stack:  # a callback on zenoh's threads must not outlive the interpreter
        if camera is not None:
            stack.enter_context(
                camera_beside(plugins.opened("camera", camera, settings, driver=driver), settings, service)
            )
        process.run()


def record(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file to include in the log.")] = None,
    folder: Annotated[str | None, typer.Option(help="Folder of the logs; default: recorder.folder.")] = None,
    largest_mb: Annotated[float | None, typer.Option(help="Size at which the next log is started.")] = None,
    longest_s: Annotated[float | None, typer.Option(help="Duration after which the next log is started.")] = None,
    min_free_mb: Annotated[float | None, typer.Option(help="Free disk space below which recording stops.")] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Record every Nth frame and mirror state, but all steps and commands.")
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(
            help="Topic or pattern to record among frames, mirror state, mirror surface, truth and timing; repeat for "
            "several. Default: all."
        ),
    ] = None,
    arguments: Annotated[list[str] | None, typer.Argument(hidden=True)] = None,
    as_json: Json = False,
) -> None:
    """Record the messages of a run in MCAP logs until Ctrl-C or SIGTERM.

    Without --config the configuration is the one in the run's directory, if there is one.

    Example: lowfc record --run bench --folder logs --longest-s 600 --min-free-mb 2000
    """
    from lowfc.adapters.bus.run import open_run, run_path
    from lowfc.client.runs import waiting_message
    from lowfc.contract.configuration import load
    from lowfc.contract.messages import Role
    from lowfc.programs.core.recording.process import record as run_recorder
    from lowfc.programs.core.recording.summary import json_object, report

    overrides = {
        "recorder.folder": folder,
        "recorder.largest_mb": largest_mb,
        "recorder.longest_s": longest_s,
        "recorder.min_free_mb": min_free_mb,
        "recorder.every": every,
        "recorder.topics": topics or None,
    }
    if arguments:
        first = arguments[0]
        hint = f"; `lowfc ctl record {first}` controls a running recorder" if first in ("start", "stop") else ""
        raise ConfigurationError(f"lowfc record takes options only, got {' '.join(arguments)!r}{hint}")
    run_config = run_path(run) / "config.toml"
    settings = configuration(run_config if config is None and run_config.exists() else config, overrides)
    joined = open_run(run, (settings.mirror.name,), network=settings.network)
    shared = None  # configuration for the run's other processes, without the options of this command
    if config is not None and Role.LAUNCHER not in joined.links.ports:
        shared = load(config).to_toml().encode()
    if not joined.links.network.router and (waiting := waiting_message(run)):
        typer.echo(f"recorder: {waiting}", err=True)
    summary = run_recorder(joined, settings, calibration, shared)
    typer.echo(json.dumps(json_object(summary)) if as_json else report(summary), err=not as_json)
    if summary.failure:
        raise typer.Exit(1)
