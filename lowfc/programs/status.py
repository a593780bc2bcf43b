"""What a person sees of a running loop: a screen, a line, a summary."""

from typing import Any

from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from lowfc.adapters.run import mirror_role
from lowfc.contract.configuration import Configuration
from lowfc.contract.events import Level
from lowfc.contract.messages import COMMAND, FRAME, Role, wire
from lowfc.contract.printable import printable
from lowfc.control.safety import LoopMode
from lowfc.programs.watch import Watch, topic_count

_EVENTS_SHOWN = 4
_STYLES = {Level.WARNING: "yellow", Level.ERROR: "red", Level.FATAL: "bold red"}


def screen(watch: Watch, config: Configuration, duration_s: float | None, elapsed_s: float) -> Panel:
    """The live status of a loop."""
    camera, controller = watch.of(Role.CAMERA), watch.of(Role.CONTROLLER)
    mirror, recorder = watch.of(mirror_role(config.mirror.name)), watch.of(Role.RECORDER)
    frames, wavefront = topic_count(controller, FRAME.key), camera.wavefront
    commands = topic_count(mirror, COMMAND.at(config.mirror.name))
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", justify="right")
    table.add_column()
    table.add_row("loop", f"{mode(controller)}, {camera.rate_hz:.0f} Hz of {config.camera.rate_hz:g} Hz")
    table.add_row(
        "wavefront",
        f"{wavefront.residual_rms_nm:.2f} nm rms left of {wavefront.disturbance_rms_nm:.2f} nm; "
        f"tilt {wavefront.tilt_residual_mas:.2f} mas of {wavefront.tilt_disturbance_mas:.2f} mas per axis",
    )
    table.add_row("frame to command", latency(controller.frame_to_command))
    table.add_row("frame to mirror", latency(camera.frame_to_mirror))
    table.add_row("frames", f"{frames.received} received, {frames.skipped} skipped, {frames.missing} missing")
    table.add_row("mirror", f"{mirror.state or 'not there yet'}, {commands.received} commands")
    table.add_row("recorder", recording(recorder))
    for log in watch.events[-_EVENTS_SHOWN:]:
        table.add_row(Text(printable(log.name)), Text(printable(log.message), style=_STYLES.get(Level(log.level), "")))
    left = f" of {duration_s:g} s" if duration_s is not None else ", Ctrl-C ends it"
    what = f"{config.disturbance.preset}, V = {config.star.magnitude:g}, {config.sensor.sam}"
    return Panel(Group(table), title="lowfc", subtitle=f"{what}; {elapsed_s:.0f} s{left}", expand=False)


def status_line(watch: Watch, elapsed_s: float) -> str:
    """The same in one line, where there is no terminal."""
    camera, controller = watch.of(Role.CAMERA), watch.of(Role.CONTROLLER)
    frames = topic_count(controller, FRAME.key)
    return (
        f"{elapsed_s:5.0f} s  {mode(controller)}  {camera.rate_hz:6.0f} Hz  "
        f"residual {camera.wavefront.residual_rms_nm:.2f} of {camera.wavefront.disturbance_rms_nm:.2f} nm rms  "
        f"frame to command {latency(controller.frame_to_command)}  "
        f"skipped {frames.skipped} missing {frames.missing}  {recording(watch.of(Role.RECORDER))}"
    )


def mode(controller: wire.Health) -> str:
    """Loop mode in words."""
    return LoopMode(controller.mode).name.lower() if controller.mode else "starting"


def latency(durations: wire.Latency) -> str:
    """Percentiles in one line."""
    if not durations.count:
        return "-"
    p50, p99, largest = (value / 1e3 for value in (durations.p50_ns, durations.p99_ns, durations.max_ns))
    return f"p50 {p50:.0f} us, p99 {p99:.0f} us, max {largest:.0f} us"


def recording(recorder: wire.Health) -> str:
    """What the recorder has."""
    if not recorder.process:
        return "not recording"
    done = recorder.recording
    return f"{done.messages} messages, {done.bytes / 1e6:.1f} MB, {done.lost} lost"


def summary_text(figures: dict[str, Any]) -> str:
    """The summary of a run for a person."""
    command, mirror = (figures["latency_us"][name] for name in ("frame_to_command", "frame_to_mirror"))

    def percentiles(values: dict[str, float]) -> str:
        return "   ".join(f"{name.replace('_', '.')} {value:.0f} us" for name, value in values.items())

    not_closed = f"not closed for {figures['not_closed_s']:.1f} s: {figures['not_closed_cause']}"
    lines = [
        f"loop               {not_closed if figures['not_closed_s'] else 'closed all the time'}",
        f"rate               {figures['rate_hz']:.1f} Hz",
        f"frames             {figures['frames_published']} published, {figures['frames_processed']} processed, "
        f"{figures['frames_skipped']} skipped, {figures['frames_missing']} missing",
        f"commands           {figures['commands_applied']} applied, {figures['commands_late']} after the next exposure "
        "had begun",
        f"wavefront          {figures['residual_rms_nm']:.2f} nm rms left of {figures['disturbance_rms_nm']:.2f} nm",
        f"tilt per axis      {figures['tilt_residual_mas']:.2f} mas rms left of "
        f"{figures['tilt_disturbance_mas']:.2f} mas",
        f"frame to command   {percentiles(command)}",
        f"frame to mirror    {percentiles(mirror)}",
    ]
    if figures["log"]:
        lines.append(
            f"log                {' '.join(figures['logs'])}: {figures['messages_recorded']} messages, "
            f"{figures['messages_lost']} lost"
        )
    lines += [f"lost               {count} of {topic}" for topic, count in figures["lost"].items()]
    if figures["recording_failure"]:
        lines.append(f"recording stopped  {figures['recording_failure']}")
    return "\n".join(lines)
