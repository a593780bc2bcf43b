"""Why each event occurs and what to do: the second half of its entry in the troubleshooting page."""

from typing import NamedTuple


class Advice(NamedTuple):
    """Of one event, or of one reason.

    Attributes:
        why: its cause.
        what: what the operator does.
    """

    why: str
    what: str


_NOTHING = "nothing; this is for the log."

ADVICE: dict[str, Advice] = {
    "STARTED": Advice("a process has started.", _NOTHING),
    "STOPPED": Advice("a process has ended, for the named reason.", "start it again if nobody meant to stop it."),
    "CLOCK_OFF": Advice(
        "the wall clock was set after the boot, and the times of a run keep the offset that this boot began with.",
        "let a time server set the clock before the loop starts; `lowfc doctor` shows the difference.",
    ),
    "REALTIME_REFUSED": Advice(
        "the host does not grant a real-time measure (SCHED_FIFO, locked memory, awake processors).",
        "run `lowfc doctor`, which names the right that is missing; until then latencies have a longer tail.",
    ),
    "KERNEL": Advice("`realtime.kernel` asks for this arithmetic of the control step.", _NOTHING),
    "KERNEL_MISSING": Advice(
        "`realtime.kernel` asks for the fused step, and numba is not installed.",
        "install the extra `fast`; the loop is the same without it, and takes longer for a frame.",
    ),
    "CALIBRATION_LOADED": Advice("a calibration is in use, at the start or after `load`.", _NOTHING),
    "NOT_CALIBRATED": Advice(
        "there is no calibration, or the camera's frames have another size than it.",
        "`lowfc ctl load FILE`, `lowfc calibrate` or `lowfc commission`; frames are not used until then.",
    ),
    "CAMERA_CHANGED": Advice(
        "size, bias or saturation of the camera's frames are not those of the calibration; a closed loop opens.",
        "set the camera as it was, or load a calibration that was made with these settings.",
    ),
    "MODE_CHANGED": Advice("the loop mode changed, for the named reason.", "nothing, where the reason is a request."),
    "SAFED": Advice(
        "an operator, an interlock, SIGUSR1 or a latch of before made the loop safe; the mirror is flat.",
        "remove the cause, then `lowfc ctl clear`; the loop is open afterwards, and `lowfc ctl close` closes it.",
    ),
    "FRAMES_REFUSED": Advice(
        "frames arrive and are not used; the command is held. The reason is one of the table of reasons.",
        "what the table of reasons says for the reason.",
    ),
    "FRAMES_ACCEPTED": Advice("frames are used again.", _NOTHING),
    "NO_FRAMES": Advice(
        "no frame for `control.frame_timeout_ms`: the camera stands still, waits for a trigger, or its link is down.",
        "look at the camera's process (`lowfc hosts`) and at its driver's events; the loop goes on by itself "
        "when frames come.",
    ),
    "FRAMES_BACK": Advice("frames come again after a silence.", _NOTHING),
    "FRAMES_MISSING": Advice(
        "frames were lost on the way, or the controller was held up and skipped them.",
        "if it is often: `lowfc doctor`, a lower `camera.rate_hz`, processors of their own for camera and controller.",
    ),
    "STREAM_SILENT": Advice(
        "nobody writes into the ImageStreamIO stream, or its writer died in the middle of an image.",
        "start the writer; the driver goes on by itself.",
    ),
    "STREAM_RENEWED": Advice(
        "the writer made the stream anew.", "nothing, unless the size changed: then load a calibration of this size."
    ),
    "CAMERA_RESTARTED": Advice(
        "the camera's numbers began anew; frames are not used before its settings were received.",
        "nothing; if nobody restarted it, look at the events of the camera's process.",
    ),
    "MIRROR_ADOPTED": Advice("the controller started under a mirror that had a modal command.", _NOTHING),
    "SHAPE_ADOPTED": Advice(
        "the mirror had a shape that no modal command explains, as after a restart of the controller.",
        "keep it if it is a dark hole; else `lowfc ctl channel adopted --zero`.",
    ),
    "LAW_NOT_IN_FORCE": Advice(
        "the law of `control.law` was refused: another frame rate, other modes, or not stable at this delay.",
        "tune a law for this loop (`lowfc tune`), or take `control.law` out; the loop starts open.",
    ),
    "LAW_OVERRULED": Advice(
        "the guard found that the law leaves more than the integrator would, or amplifies.",
        "tune a law anew from a log of now; `lowfc ctl law FILE` or `close` gives it another chance.",
    ),
    "LAW_BACK": Advice("the law would have been far better for long, and drives again.", _NOTHING),
    "NOTE": Advice("an operator left a note.", _NOTHING),
    "CLOSING_HARMS": Advice(
        "the gains that were set bring more noise into some modes than there is to correct.",
        "`lowfc ctl gain auto`, or lower gains of the modes that the event names.",
    ),
    "GAINS_CHANGED": Advice("automatic gains moved.", _NOTHING),
    "STAR_CHANGED": Advice(
        "the light changed by more than 20 % for half a second; automatic gains are lowered and measured anew.",
        "nothing after a slew; else look for clouds, a vignetted beam or another exposure.",
    ),
    "LOOP_HARMS": Advice(
        "in three windows in a row the closed loop left more than an open one would: too much noise for the gains, a "
        "wrong calibration, a wrong delay.",
        "`lowfc ctl gain auto`; if it returns, check calibration and `control.delay_frames`. `control.on_harm` can "
        "open the loop by itself.",
    ),
    "PLAY_ENDED": Advice(
        "a probe sequence ended early: a restart, a silence, a limit, or an operator.",
        "remove the cause, and run the calibration or test again (`--resume` where it has it).",
    ),
    "LEASE_TAKEN": Advice("a program reserved the loop.", "wait, or `lowfc ctl open`, which ends the reservation."),
    "LEASE_RELEASED": Advice("the program is done.", _NOTHING),
    "LEASE_ENDED": Advice(
        "the holder was not heard in time, or somebody asked for safe, open, pause or stop.",
        "look at the program that held it; it must stop by itself.",
    ),
    "INTERLOCK_ACTS": Advice(
        "a value of the bench meets a condition of `[[interlocks]]`, or is too old.",
        "see to the cause, or to the publisher of the value.",
    ),
    "INTERLOCK_CLEARED": Advice("the condition no longer holds.", "close the loop again, if the interlock opened it."),
    "LOOP_STEPPED": Advice("`lowfc ctl step` is done.", "`lowfc ctl close`, if the residual fell."),
    "MIRROR_LOST": Advice(
        "the mirror's process died, hangs, or does not follow; a closed loop holds its command.",
        "look at the mirror's process and its driver's events; start it again. The loop goes on by itself.",
    ),
    "MIRROR_BACK": Advice("the mirror follows again.", _NOTHING),
    "MIRROR_REFUSED": Advice(
        "the mirror reports another grid than the calibration's, or values that are not finite.",
        "set `mirror.rows` and `mirror.columns`, or load the calibration of this mirror.",
    ),
    "LIMIT_HIT": Advice(
        "a limit of the controller or the mirror cut a command. The reason is one of the table of reasons.",
        "what the table of reasons says for the reason; a short one after closing is usual.",
    ),
    "LIMIT_CLEARED": Advice("the limit acts no more.", _NOTHING),
    "COMMAND_EXPIRED": Advice(
        "the mirror had no good command for `control.command_timeout_ms`: the controller is dead, hangs, or is cut "
        "off. The mirror relaxes to flat or holds (`mirror.on_command_timeout`).",
        "start the controller again; it begins from the mirror's shape, open.",
    ),
    "COMMAND_BACK": Advice("the mirror follows commands again.", _NOTHING),
    "COMMAND_REFUSED": Advice(
        "a command was not finite, of another grid, out of order, or on an unusable channel.",
        "look who commands this mirror (`lowfc hosts`): only one controller may.",
    ),
    "START_AHEAD": Advice(
        "the clock of the sender's host is ahead by more than `control.max_start_ahead_h`.",
        "set the clocks of both hosts and start the sender again; `lowfc ctl clear` forgets a wrong frame number.",
    ),
    "LATCH_FAILED": Advice(
        "the file that keeps safe mode across restarts cannot be written.",
        "make the directory that the event names writable; safe mode itself is in force.",
    ),
    "COMMANDS_LATE": Advice(
        "more than a quarter of the last 500 commands were applied after the next exposure had begun, so the loop has "
        "a frame more of delay than it counts with.",
        "lower `camera.rate_hz`, or give the loop its processors and real-time rights (`lowfc doctor`); if the bench "
        "is that slow, set `control.delay_frames` to the measured delay.",
    ),
    "COMMANDS_IN_TIME": Advice("less than an eighth of the commands are late.", _NOTHING),
    "FRAMES_LOST": Advice(
        "the camera's own frame numbers have gaps: it, its cable or its driver lost them.",
        "look at cable, bandwidth and packet size; a lower rate or a smaller region helps.",
    ),
    "DRIVER_FAILED": Advice(
        "the driver raised an exception, or returned a frame that does not fit its settings.",
        "read the cause in the event; the loop tries again by itself.",
    ),
    "DRIVER_HANGS": Advice(
        "a call of the driver does not return.", "look at the hardware; if it stays, restart the driver's process."
    ),
    "DRIVER_BACK": Advice("the driver works again.", _NOTHING),
    "RECORDING": Advice("a log is being written.", _NOTHING),
    "RECORDING_STOPPED": Advice("the log is finished.", "`lowfc ctl record start` begins the next one."),
    "MESSAGES_LOST": Advice(
        "the recorder did not get or could not write so many messages of a topic.",
        "give the recorder a processor of its own or a faster disk; `replay` says which steps it cannot check.",
    ),
    "RECORDING_FAILED": Advice(
        "the disk is full, refuses to write, or the folder is gone. What is written is complete.",
        "make room, then `lowfc ctl record start`; the loop goes on without a log.",
    ),
    "DISK_SLOW": Advice("one write took long; messages waited in memory.", "use a faster or less busy disk."),
    "ON_EVENT_FAILED": Advice(
        "the shell command of `recorder.on_event` failed or took more than 60 s.", "run it by hand, and mend it."
    ),
    "VIEW_STUCK": Advice("the viewer takes no data.", "close its window, or wait: it begins anew by itself."),
    "VIEW_RENEWED": Advice(
        "the viewer hung or had used its memory.", "load a page in a browser again; a window comes back by itself."
    ),
    "BAD_MESSAGE": Advice(
        "a message could not be decoded or is of an impossible time: another version, or a program with a fault.",
        "look who publishes on the topic; `lowfc conformance` checks a camera or a mirror.",
    ),
}

REASONS: dict[str, Advice] = {
    "NO_CALIBRATION": Advice("no calibration is loaded", "load or measure one"),
    "WRONG_SIZE": Advice("rows, columns, encoding or bytes are not the calibration's", "set the camera's region"),
    "OUT_OF_ORDER": Advice("an older frame than the last one", "nothing, unless two cameras publish in one run"),
    "REPEATED": Advice("the frame was used before", "nothing, unless it is often"),
    "LATE": Advice("older than `control.max_frame_age_ms` on arrival", "`lowfc doctor`; a clock of its own host"),
    "SATURATED": Advice("more than `control.max_saturated_pixels` at full well", "shorter exposure, lower gain"),
    "DARK": Advice(
        "less light than `control.min_flux_fraction` of the calibration's",
        "is the star on the mask? On a fainter star `lowfc calibrate reference`, or a lower fraction",
    ),
    "NO_FRAME": Advice("no frame in time", "as for NO_FRAMES"),
    "STUCK": Advice("the same image again and again", "restart the camera"),
    "AHEAD": Advice("the camera's start is ahead of this host's clock", "as for START_AHEAD"),
    "CAMERA_UNKNOWN": Advice(
        "the camera restarted and its settings have not come", "nothing; they come twice a second"
    ),
    "NO_MIRROR": Advice("the mirror does not follow", "as for MIRROR_LOST"),
    "HELD": Advice("an interlock or a permit holds the loop", "wait, or see to the interlock"),
    "MODAL_LIMIT": Advice("a modal command reached its limit", "`lowfc ctl limit`; offload; is the star centred?"),
    "STROKE": Advice("an actuator reached its stroke", "a better flat map, or smaller channels"),
    "SLEW": Advice("an actuator may not move as far in one command", "nothing after closing; else lower gains"),
    "NEIGHBOUR": Advice("neighbouring actuators would be too far apart", "smaller channels; look for a stuck actuator"),
    "NOT_FINITE": Advice("a value was not finite; the previous command is kept", "check calibration and law"),
    "WRONG_GRID": Advice("the grid is not the mirror's", "the calibration of this mirror"),
    "CHANNEL": Advice("no usable channel name, or more than sixteen", "remove a channel"),
    "LAW_OVERRULED": Advice("the integrator has taken modes over from the law", "as for LAW_OVERRULED"),
}
"""Reasons of refusals and limits, without REASON_."""
