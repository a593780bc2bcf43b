"""Status of a running loop for a terminal: a screen, a line, a summary."""

from typing import Any

from rich.console import Group
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from lowfc.adapters.bus.run import mirror_role
from lowfc.contract.configuration import Configuration
from lowfc.contract.events import Level
from lowfc.contract.messages import COMMAND, FRAME, Role, wire
from lowfc.contract.printable import printable
from lowfc.control.loop.wording import counted, hertz, mode_word
from lowfc.programs.cli.contrast import QUADRATIC, contrast_cases, contrast_in_words, costliest_modes
from lowfc.programs.launch.watch import Watch, mode_name, topic_count, wavefront

SILENT_S = 2.0
"""Time without Health (sent twice a second) after which a notice replaces the frame rate and the wavefront."""
_RECENT_S = 2.5
"""Span of the recent wavefront statistics, plus the delay of their report."""
_EVENTS_SHOWN = 4
_MIN_DURATIONS = {"p99": 100, "p99_9": 1000}
"""Least number of durations for which a percentile is shown: with fewer, it would be the largest duration."""
_STYLES: dict[int, str] = {Level.WARNING: "yellow", Level.ERROR: "red", Level.FATAL: "bold red"}


def screen(watch: Watch, config: Configuration, duration_s: float | None, elapsed_s: float) -> Panel:
    """The live status of a loop."""
    camera, controller = watch.health_of(Role.CAMERA), watch.health_of(Role.CONTROLLER)
    mirror, recorder = watch.health_of(mirror_role(config.mirror.name)), watch.health_of(Role.RECORDER)
    frames = topic_count(controller, FRAME.key)
    commands = topic_count(mirror, COMMAND.at(config.mirror.name))
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", justify="right")
    table.add_column()
    silent = _silence_notice(watch)
    measured = f"{hertz(camera.rate_hz)} of {config.camera.rate_hz:g} Hz"
    rate = silent or _rate(measured, camera.rate_hz, config.lockstep_hz)
    table.add_row("loop", Text(f"{mode(controller)}, {rate}"))  # rich would read a string as markup
    table.add_row("wavefront", silent or _wavefront_in_words(camera))
    table.add_row("frame to command", "-" if silent else latency(controller.frame_to_command))
    table.add_row("frame to mirror", "-" if silent else latency(camera.frame_to_mirror))
    table.add_row("frames", f"{frames.received} received, {frames.skipped} skipped, {frames.missing} missing")
    table.add_row("mirror", Text(f"{printable(mirror.state) or 'starting'}, {counted(commands.received, 'command')}"))
    table.add_row("recorder", recording(recorder))
    for log in watch.events[-_EVENTS_SHOWN:]:
        table.add_row(Text(printable(log.name)), Text(printable(log.message), style=_STYLES.get(log.level, "")))
    end = f" of {duration_s:g} s" if duration_s is not None else ", Ctrl-C ends it"
    sensor = config.sensor.sam if config.sensor.kind == "sam" else config.sensor.kind
    scene = f"{config.disturbance.preset}, V = {config.star.magnitude:g}, {sensor}"
    return Panel(Group(table), title="lowfc", subtitle=Text(f"{scene}; {elapsed_s:.0f} s{end}"), expand=False)


def status_line(watch: Watch, elapsed_s: float, lockstep_hz: float | None = None) -> str:
    """The status in one line, if the output is not a terminal; `lockstep_hz` is the frame rate in simulated time."""
    camera, controller = watch.health_of(Role.CAMERA), watch.health_of(Role.CONTROLLER)
    if not camera.HasField("recent_wavefront"):
        return f"{elapsed_s:5.0f} s  no frame yet"
    if silent := _silence_notice(watch):
        return f"{elapsed_s:5.0f} s  {mode(controller)}  {silent}"
    frames, recent = topic_count(controller, FRAME.key), wavefront(camera.recent_wavefront)
    added = recent["added_contrast"]
    contrast = "" if added is None else f"contrast by quadratic form {added['closed']:+.1e} of {added['open']:+.1e}  "
    rate = _rate(f"{hertz(camera.rate_hz):>9}", camera.rate_hz, lockstep_hz)
    just_closed = _closed_for(controller, lockstep_hz or camera.mean_rate_hz)
    return (
        f"{elapsed_s:5.0f} s  {mode(controller)}{just_closed}  {rate}  "
        f"residual {recent['residual_rms_nm']:.2f} of {recent['disturbance_rms_nm']:.2f} nm rms  {contrast}"
        f"frame to command {latency(controller.frame_to_command)}  "
        f"skipped {frames.skipped} missing {frames.missing}  {recording(watch.health_of(Role.RECORDER))}"
    )


def _rate(measured: str, rate_hz: float, lockstep_hz: float | None) -> str:
    """Text of the frame rate: `measured`, or in lockstep the rate in simulated time and the speed of computation."""
    computed = f", computed at {rate_hz:.4g} frames per second" if rate_hz else ""
    return measured if lockstep_hz is None else f"{lockstep_hz:g} Hz in simulated time{computed}"


def _closed_for(controller: wire.Health, rate_hz: float) -> str:
    """Text of the total time closed, if the loop is closed and this time is shorter than `_RECENT_S`; else empty.

    The recent statistics then include frames before the closing.
    """
    frames = topic_count(controller, FRAME.key).received
    closed_s = frames / rate_hz - controller.not_closed_ns * 1e-9 if rate_hz else 0.0
    just_closed = controller.mode == wire.LOOP_MODE_CLOSED and 0 < closed_s < _RECENT_S
    return f" for {closed_s:.1f} s" if just_closed else ""


def _silence_notice(watch: Watch) -> str:
    """A notice if controller or camera stopped sending Health, so that its values are out of date; otherwise empty."""
    for name in (Role.CONTROLLER, Role.CAMERA):
        if watch.health_of(name).process and (silent_s := watch.silent_s(name)) > SILENT_S:
            return f"the {name} has been silent for {silent_s:.0f} s"
    return ""


def _wavefront_in_words(camera: wire.Health) -> str:
    if not camera.HasField("recent_wavefront"):
        return "no frame yet"
    recent = wavefront(camera.recent_wavefront)
    return (
        f"residual {recent['residual_rms_nm']:.2f} of {recent['disturbance_rms_nm']:.2f} nm rms; "
        f"tilt {recent['tilt_residual_mas']:.2f} mas of {recent['tilt_disturbance_mas']:.2f} mas per axis"
    )


def mode(controller: wire.Health) -> str:
    """Text of the loop mode, with the reason if a closed loop holds its command."""
    word = mode_word(mode_name(controller.mode) or "starting")
    return f"{word} (not correcting: {printable(controller.holding)})" if controller.holding else word


def latency(durations: wire.Latency) -> str:
    """Percentiles of a latency in one line."""
    if not durations.count:
        return "-"
    p50, p99, largest = (value / 1e3 for value in (durations.p50_ns, durations.p99_ns, durations.max_ns))
    return f"p50 {p50:.0f} us, p99 {p99:.0f} us, max {largest:.0f} us"


def recording(recorder: wire.Health) -> str:
    """Text of the recorder's messages, bytes and losses."""
    if not recorder.process:
        return "not recording"
    recorded = recorder.recording
    return f"{counted(recorded.messages, 'message')}, {recorded.bytes / 1e6:.1f} MB, {recorded.lost} lost"


def _loop_in_words(results: dict[str, Any]) -> str:
    cause = f": {results['not_closed_cause']}" if results["not_closed_cause"] else ""
    match results["mode"]:
        case None:
            return "no controller reported"
        case "closed" if not results["not_closed_s"]:
            return "closed"
        case mode if not results["closed_fraction"]:
            return f"closed only at the end{cause}" if mode == "closed" else f"{mode_word(mode)}; never closed{cause}"
        case mode:
            seconds = results["not_closed_s"]
            return f"{mode_word(mode)}; not closed for {seconds:{'.1f' if seconds >= 1 else '.2g'}} s in total{cause}"


def _sampling(results: dict[str, Any], name: str, instants: str = "") -> str:
    """Text of the times at which a statistic of the true wavefront is sampled."""
    if results["instants_per_frame"] == 1:
        return "sampled at the start of each exposure"
    return f"continuous ({instants}{results[f'sampled_{name}']:.2f} at exposure start)"


def _contrast_lines(results: dict[str, Any]) -> list[str]:
    """The line with the contrast added to the dark zone; empty if unknown."""
    added = results["added_contrast"]
    if added is None:
        return []
    own = results["dark_zone_contrast"]
    coronagraph = "" if own is None else f"coronagraph alone {own:.1e}; "
    beyond = ("residual",) if results["beyond_quadratic"] else ()
    method = QUADRATIC if results["beyond_quadratic"] is None else "; computed from full images of the true wavefront"
    costliest = None if beyond else costliest_modes(results)  # the share is of the quadratic form
    return [f"contrast           {coronagraph}{contrast_in_words(contrast_cases(added), costliest, beyond, method)}"]


def _wavefront_lines(results: dict[str, Any]) -> list[str]:
    """The lines with the true wavefront and the contrast; without a frame there are no values."""
    if not results["frames_published"]:
        return ["wavefront          no frame"]
    partly = ", in part not closed" if 0 < results["closed_fraction"] < 0.5 else ""
    return [
        f"wavefront          residual {results['residual_rms_nm']:.2f} of {results['disturbance_rms_nm']:.2f} nm rms "
        f"over the open pupil, second half of the run{partly}, "
        + _sampling(results, "residual_rms_nm", f"{results['instants_per_frame']} instants per frame; "),
        f"tilt per axis      residual {results['tilt_residual_mas']:.2f} of "
        f"{results['tilt_disturbance_mas']:.2f} mas rms, second half, " + _sampling(results, "tilt_residual_mas"),
        *_contrast_lines(results),
    ]


def summary_text(results: dict[str, Any], lockstep_hz: float | None = None) -> str:
    """The summary of a run as text; `lockstep_hz` is the frame rate in simulated time, None without lockstep."""
    command, mirror = (results["latency_us"][name] for name in ("frame_to_command", "frame_to_mirror"))

    def percentiles(values: dict[str, float], count: int) -> str:
        if not values["max"]:
            return "-"
        shown = {name: value for name, value in values.items() if count >= _MIN_DURATIONS.get(name, 1)}
        return "   ".join(f"{name.replace('_', '.')} {value:.0f} us" for name, value in shown.items())

    measured = f"{results['rate_hz']:.1f} Hz" if results["rate_hz"] else "-"
    lines = [
        f"loop               {_loop_in_words(results)}",
        f"rate               {_rate(measured, results['rate_hz'], lockstep_hz)}",
        f"frames             {results['frames_published']} published, {results['frames_processed']} processed, "
        f"{results['frames_skipped']} skipped, {results['frames_missing']} missing",
        f"commands           {results['commands_applied']} applied, {results['commands_late']} after the start of the "
        "next exposure",
        *_wavefront_lines(results),
        f"frame to command   {percentiles(command, results['frames_processed'])}",
        f"frame to mirror    {percentiles(mirror, results['commands_applied'])}",
    ]
    if results["log"]:
        lines.append(
            f"log                {' '.join(results['logs'])}: {counted(results['messages_recorded'], 'message')}, "
            f"{results['messages_lost']} lost"
        )
    lines += [f"lost               {count} of {topic}" for topic, count in results["lost"].items()]
    if results["recording_failure"]:
        lines.append(f"recording stopped  {results['recording_failure']}")
    return "\n".join(lines)
