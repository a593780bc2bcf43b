"""The command `lowfc view`."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import AnyRun, ConfigFile, LogsIfAny, configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.programs.view.draw.tabs import Tab

_MEMORY_MB = 512.0


def view(
    logs: LogsIfAny = None,
    native: Annotated[bool, typer.Option("--native", help="Show in a window.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve a page for a browser on this host.")] = False,
    save: Annotated[Path | None, typer.Option(help="Write a file (RRD) for rerun.")] = None,
    headless_screenshot: Annotated[Path | None, typer.Option(help="Write a picture (PNG), without a screen.")] = None,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve the loop to Foxglove, by its WebSocket protocol.")
    ] = False,
    tab: Annotated[Tab, typer.Option(help="Tab to open.")] = Tab.OPERATOR,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Show a running loop for this long; default for a picture: 8 s.")
    ] = None,
    run: AnyRun = None,
    config: ConfigFile = None,
    memory_mb: Annotated[float, typer.Option(min=16, max=1e6, help="Viewer's memory for past data, MB.")] = _MEMORY_MB,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="TCP port of the viewer, or for Foxglove.")] = None,
    web_port: Annotated[int | None, typer.Option(min=1, max=65535, help="TCP port of the page.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object at the end.")] = False,
) -> None:
    """Show a running loop or logs in a window, a browser, a picture or a file.

    Default: a window, or a page for a browser if there is no screen.

    Example: lowfc view --web
    """
    from lowfc.adapters.process.realtime import lower_priority
    from lowfc.client.runs import the_known_run

    lower_priority()
    if foxglove:
        other_options = logs, native, web, save, headless_screenshot, seconds, config, as_json, web_port
        if any(other_options) or tab != Tab.OPERATOR or memory_mb != _MEMORY_MB:
            raise ConfigurationError(
                "--foxglove serves a running loop until Ctrl-C; of the other options, it takes only --run and --port"
            )
        from lowfc.adapters.process.clock import HostClock
        from lowfc.programs.view.foxglove_bridge import DEFAULT_PORT, serve_foxglove

        serve_foxglove(the_known_run(run), HostClock(), DEFAULT_PORT if port is None else port)
        return
    if logs and (seconds or run):
        raise ConfigurationError("--seconds and --run are for a running loop, not for logs")
    from lowfc.adapters.logs.parts import named_files
    from lowfc.programs.view.session import show_logs, show_run
    from lowfc.programs.view.target import Target

    target = Target(native, web, save, headless_screenshot, tab, memory_mb, port or 0, web_port or 0)
    settings = None if config is None else configuration(config)
    if logs:
        results = show_logs(named_files(logs), settings, target)
    else:
        results = show_run(the_known_run(run), settings, target, seconds)
    if as_json:
        sys.stdout.write(json.dumps(results) + "\n")
