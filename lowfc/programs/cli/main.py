"""The command `lowfc`: the table of all commands; each is imported on use."""

import sys
from typing import Annotated

import typer

from lowfc import __version__
from lowfc.adapters.process.terminal import run_app
from lowfc.programs.cli.lazy_group import Row, lazy_app

COMMANDS = {
    "Run": (
        Row("sim-loop", "launch.command:sim_loop", "Run the simulated loop: camera, mirror, controller, recorder."),
        Row("ctl", "cli.ctl:ctl_app", "Operate a running loop: status, open, close, gain, offset."),
        Row("console", "console.command:console", "Operate a running loop from one screen."),
        Row("controller", "cli.processes:controller", "Run the controller: frames in, mirror commands out."),
        Row("camera", "cli.devices:camera_app", "Run a camera: publish the frames of its driver."),
        Row("mirror", "cli.devices:mirror_app", "Run a mirror: its driver applies a run's commands."),
        Row("record", "cli.processes:record", "Record the messages of a run."),
        Row("bridge", "", "Share a mirror with CACAO or another control system."),
        Row("gateway", "", "Serve a run to an observatory's control system (EPICS)."),
        Row("config", "", "Show and check the configuration."),
        Row("certs", "cli.hosts:certs", "Make the certificates of a run on several hosts."),
        Row("router", "cli.hosts:router", "Run the router of a run on several hosts."),
    ),
    "Look": (
        Row("runs", "cli.runs:runs", "List the runs on this host."),
        Row("view", "view.command:view", "Show a running loop or a log: window, browser, picture."),
        Row("hosts", "cli.hosts:hosts", "List the processes of a run and the clocks of their hosts."),
    ),
    "Logs": (
        Row("info", "logs.info:info", "Summarise a log: what ran, when, and what was recorded."),
        Row("report", "logs.report.command:report", "Summarise a run from its log in one HTML page."),
        Row("replay", "logs.replay.command:replay_log", "Replay a log through the controller and compare."),
        Row("what-if", "logs.what_if.command:what_if", "Compute the residual of a log with other gains or laws."),
        Row("publish", "logs.publish.command:publish", "Republish a log on a run's bus."),
        Row("export", "logs.export.command:export", "Write steps, calibration and frames of a log for other tools."),
        Row("recover", "logs.recover:recover", "Recover a truncated or damaged log."),
    ),
    "Commission": (
        Row("doctor", "commissioning.doctor.command:doctor", "Check this host for real-time operation."),
        Row("conformance", "commissioning.conformance.command:conformance_app", "Check a camera or mirror driver."),
        Row("commission", "commissioning.commission.command:commission", "Commission a new camera and mirror."),
        Row("calibrate", "commissioning.calibrate.command:calibrate_app", "Measure or compute a calibration."),
        Row("tune", "commissioning.tune.command:tune", "Find the best control law for a log or a running loop."),
        Row("acceptance", "commissioning.acceptance.command:acceptance_app", "Test a loop against its requirements."),
    ),
    "Measure": (
        Row("latency", "measure.latency.command:latency", "Measure the latency from frame to command on this host."),
        Row("bench", "", "Measure the speed of the optical model and of recording."),
    ),
    "Verify": (
        Row("validate", "paper.commands:validate", "Reproduce the tables and figures of the paper."),
        Row("chaos", "reliability.chaos.command:chaos", "Inject faults into a simulated loop and check its log."),
        Row("soak", "reliability.soak.command:soak", "Run the simulated loop for hours and watch its resources."),
    ),
    "Design": (Row("design", "design.command:design_app", "Design shaped pupils and sparse aperture masks."),),
}
"""Commands by purpose, in the order of `lowfc --help`; a row without a target is a group (see `GROUP_COMMANDS`)."""
GROUP_COMMANDS = (
    Row("bridge isio", "bridge.isio:bridge_isio", "Write steps to ImageStreamIO streams, report other channels."),
    Row("config show", "cli.config:config_show", "Print every key with its value and description, as TOML."),
    Row("config check", "cli.config:config_check", "Check a configuration file and the files it names."),
    Row("config zenoh", "cli.config:config_zenoh", "Print the zenoh configuration for your own program."),
    Row("gateway epics", "gateway.command:epics", "Serve a run by EPICS PV Access."),
    Row("bench twin", "measure.bench.twin:twin", "Time the real-time optical model against the full one."),
    Row("bench record", "measure.bench.record:bench_record", "Measure the cost of recording."),
)

app = lazy_app(
    "Low-order wavefront control for coronagraphs.\n\nExample: lowfc sim-loop --duration 20", COMMANDS, GROUP_COMMANDS
)


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Low-order wavefront control for coronagraphs."""
    if version:
        sys.stdout.write(__version__ + "\n")
    elif context.invoked_subcommand is None:
        sys.stdout.write(context.get_help() + "\n")


def main() -> None:
    """Entry point."""
    run_app(app)
