"""Definitions of all events: name, level and description for the operator. They are sent as Foxglove log messages."""

from dataclasses import dataclass
from enum import IntEnum
from numbers import Integral

from lowfc.contract.messages import Log, timestamp
from lowfc.contract.printable import printable
from lowfc.control.loop.wording import counted


class Level(IntEnum):
    """Severity, numbered as in Foxglove's schema."""

    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


class _Number(int):
    """A number formatted with its noun: "{count:frame}" is 1 frame or 2 frames."""

    def __format__(self, noun: str) -> str:
        return counted(self, noun) if noun.isalpha() and len(noun) > 1 else super().__format__(noun)


@dataclass(frozen=True, slots=True)
class Event:
    """Definition of an event; `description` is a format string for its details."""

    name: str
    level: Level
    description: str

    def log(self, process: str, time_ns: int, /, **details: object) -> Log:
        """Message of one occurrence: "NAME description", from `process`, at `time_ns` (nanoseconds since the epoch).

        Control characters in the details are shown as escapes: the message is one line for a terminal.
        """
        details = {name: _Number(value) if isinstance(value, Integral) else value for name, value in details.items()}
        return Log(
            timestamp=timestamp(time_ns),
            level=self.level.value,  # type: ignore[arg-type]  # the schema's enum is a plain int at run time
            message=printable(f"{self.name} {self.description.format(**details)}"),
            name=process,
        )


EVENTS: dict[str, Event] = {
    event.name: event
    for event in (
        Event("STARTED", Level.INFO, "{process} {version} started"),
        Event("STOPPED", Level.INFO, "{process} stopped: {why}"),
        Event(
            "CLOCK_OFF",
            Level.WARNING,
            "the clock of all runs is {ahead_ms:+.0f} ms from the wall clock, and so are all times; see `lowfc doctor`",
        ),
        Event("REALTIME_REFUSED", Level.WARNING, "the host refused {measure}: {cost}"),
        Event("KERNEL", Level.INFO, "control step: {kernel}"),
        Event("KERNEL_MISSING", Level.WARNING, "control step: numpy instead of fused: {advice}"),
        Event("CALIBRATION_LOADED", Level.INFO, "calibration {id}: {modes:mode}, {estimator}, from {source}"),
        Event("NOT_CALIBRATED", Level.WARNING, "the loop is idle: {why}"),
        Event("CAMERA_CHANGED", Level.WARNING, "the camera does not fit the calibration: {what}"),
        Event("MODE_CHANGED", Level.INFO, "loop {before} -> {after}: {why}"),
        Event("SAFED", Level.ERROR, "loop in safe mode: {why}; `lowfc ctl clear` when it is safe"),
        Event("FRAMES_REFUSED", Level.WARNING, "frames refused: {reason}"),
        Event("FRAMES_ACCEPTED", Level.INFO, "frames accepted again; {refused:frame} refused: {reason}"),
        Event("NO_FRAMES", Level.WARNING, "no frame for {silent_ms:.0f} ms; {action}"),
        Event("FRAMES_BACK", Level.INFO, "frames are back, the first exposed {silent_ms:.0f} ms after the last"),
        Event("FRAMES_MISSING", Level.WARNING, "{count:frame} missing or skipped before frame {number}"),
        Event("STREAM_SILENT", Level.WARNING, "no image in stream {stream}: {why}"),
        Event("STREAM_RENEWED", Level.WARNING, "stream {stream} was recreated: {columns} x {rows} pixels"),
        Event("CAMERA_RESTARTED", Level.WARNING, "the camera restarted"),
        Event("MIRROR_ADOPTED", Level.INFO, "starting from the mirror's command, {rms_nm:.1f} nm rms of wavefront"),
        Event(
            "SHAPE_ADOPTED",
            Level.WARNING,
            "the mirror had {rms_nm:.1f} nm rms of surface outside the modes: kept as the channel 'adopted'; "
            "`lowfc ctl channel adopted --zero` removes it",
        ),
        Event("FLAT_NOT_IN_FORCE", Level.WARNING, "the flat map of the configuration is not in force: {why}"),
        Event("LAW_NOT_IN_FORCE", Level.WARNING, "the law of the configuration is not in force: {why}"),
        Event(
            "LAW_OVERRULED",
            Level.WARNING,
            "the integrator takes over {modes} from the law {law!r}: {why}; this lasts {until}",
        ),
        Event("LAW_BACK", Level.INFO, "the law {law!r} drives {modes} again"),
        Event("NOTE", Level.INFO, "{text}"),
        Event("CLOSING_HARMS", Level.WARNING, "{harm}"),
        Event("GAINS_CHANGED", Level.INFO, "automatic gains: {gains}"),
        Event("STAR_CHANGED", Level.WARNING, "the flux changed by a factor of {ratio:.3g}: gains are measured again"),
        Event(
            "LOOP_HARMS",
            Level.WARNING,
            "the loop increases the residual, mostly {modes}: {closed_nm:.3g} nm rms instead of {open_nm:.3g} nm in "
            "open loop; {action}",
        ),
        Event("PLAY_ENDED", Level.WARNING, "the probe sequence ended: {why}"),
        Event("LEASE_TAKEN", Level.INFO, "the loop is reserved for {holder}"),
        Event("LEASE_RELEASED", Level.INFO, "the loop is no longer reserved for {holder}"),
        Event("LEASE_ENDED", Level.WARNING, "the loop is no longer reserved for {holder}: {why}"),
        Event("INTERLOCK_ACTS", Level.WARNING, "interlock: {why}; {action}"),
        Event("INTERLOCK_CLEARED", Level.INFO, "interlock no longer acts: {why}"),
        Event("LOOP_STEPPED", Level.INFO, "the loop opened after its last step"),
        Event(
            "MIRROR_LOST",
            Level.ERROR,
            "the mirror {fault}: until it follows, the command of a closed loop stays at the mirror's last known shape",
        ),
        Event("MIRROR_BACK", Level.INFO, "the mirror follows again"),
        Event("MIRROR_REFUSED", Level.WARNING, "the mirror's shape is not adopted: {why}"),
        Event("LIMIT_HIT", Level.WARNING, "limit reached: {reason}"),
        Event("LIMIT_CLEARED", Level.INFO, "limit no longer reached: {reason}"),
        Event("COMMAND_EXPIRED", Level.WARNING, "the last command expired after {command_timeout_ms:.0f} ms; {action}"),
        Event("COMMAND_BACK", Level.INFO, "commands are back"),
        Event("COMMAND_REFUSED", Level.WARNING, "command refused: {reason}"),
        Event(
            "START_AHEAD",
            Level.ERROR,
            "{what} refused: the sender's clock read {start} when it started, but here it is {here}; set the clocks, "
            "or control.max_start_ahead_h",
        ),
        Event(
            "LATCH_FAILED",
            Level.ERROR,
            "{why}; make it writable: until then safe mode may be lost when the controller restarts",
        ),
        Event(
            "COMMANDS_LATE",
            Level.WARNING,
            "{percent:.0f} % of the commands came after the start of the next exposure and act a frame late, which "
            "lowers the highest stable gain; reduce the frame rate or set control.delay_frames",
        ),
        Event("COMMANDS_IN_TIME", Level.INFO, "commands are in time again: {percent:.0f} % late"),
        Event("FRAMES_LOST", Level.WARNING, "{count:frame} lost by the camera"),
        Event("DRIVER_FAILED", Level.ERROR, "the driver failed and will be tried again: {why}"),
        Event("DRIVER_HANGS", Level.ERROR, "the driver has not returned for {hangs_s:.1f} s"),
        Event("DRIVER_BACK", Level.INFO, "the driver works again after {count:failure}"),
        Event("RECORDING", Level.INFO, "recording"),
        Event("RECORDING_STOPPED", Level.INFO, "recording stopped: {why}"),
        Event("MESSAGES_LOST", Level.ERROR, "{count:message} lost on {topic}"),
        Event("RECORDING_FAILED", Level.ERROR, "recording stopped: {why}"),
        Event("DISK_SLOW", Level.WARNING, "one write to disk took {stall_s:.1f} s; {waiting:message} waited"),
        Event("ON_EVENT_FAILED", Level.WARNING, "the command of recorder.on_event failed: {why}"),
        Event("VIEW_STUCK", Level.WARNING, "the viewer read nothing for {stuck_s:.0f} s; close its window if it hangs"),
        Event("VIEW_RENEWED", Level.WARNING, "the view was restarted: {why}"),
        Event("BAD_MESSAGE", Level.WARNING, "{count:message} on {topic} could not be read; the last: {why}"),
    )
}
