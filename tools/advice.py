"""Why each event occurs and what to do: the second half of its entry in the troubleshooting page."""

_NOTHING = "nothing."

ADVICE: dict[str, tuple[str, str]] = {
    "STARTED": ("a process has started.", _NOTHING),
    "STOPPED": ("a process has ended, for the named reason.", "start it again, unless it was stopped on purpose."),
    "CLOCK_OFF": (
        "the wall clock was set after the first run since boot; the times of all runs do not include that change.",
        "let a time server set the clock before the first run; `lowfc doctor` shows how to correct it later.",
    ),
    "REALTIME_REFUSED": (
        "the host does not grant a real-time measure (SCHED_FIFO, locked memory, disabled CPU idle, processors).",
        "run `lowfc doctor`, which names the missing permission; until then latencies have a longer tail.",
    ),
    "KERNEL": ("`realtime.kernel` selects this implementation of the control step.", _NOTHING),
    "KERNEL_MISSING": (
        "`realtime.kernel` selects the fused step, but numba is missing or cannot be used here.",
        "follow the event's advice; until then numpy computes the same results except for rounding, but each frame "
        "takes longer.",
    ),
    "CALIBRATION_LOADED": ("a calibration is in use, at the start or after `load`.", _NOTHING),
    "NOT_CALIBRATED": (
        "the controller started without a calibration.",
        "`lowfc ctl load FILE` or `lowfc commission`; frames are not used until then.",
    ),
    "CAMERA_CHANGED": (
        "size, region, bias, saturation or gain of the camera differ from the calibration; a closed loop opens.",
        "restore the camera's settings, or load a calibration made with the present ones.",
    ),
    "MODE_CHANGED": ("the loop mode changed, for the named reason.", "nothing, if the reason is a request."),
    "SAFED": (
        "an operator, an interlock or SIGUSR1 requested safe mode, or the controller restarted in it; the mirror "
        "relaxes to flat.",
        "remove the cause, then `lowfc ctl clear`; the loop is open afterwards, and `lowfc ctl close` closes it.",
    ),
    "FRAMES_REFUSED": ("frames arrive and are not used; the command is held.", "see the [reasons](#reasons)."),
    "FRAMES_ACCEPTED": ("frames are used again.", _NOTHING),
    "NO_FRAMES": (
        "no frame for `control.frame_timeout_ms`: the camera has stopped, waits for a trigger, or its link is down.",
        "check the camera's process (`lowfc hosts`) and its driver's events; the loop resumes by itself "
        "when frames arrive.",
    ),
    "FRAMES_BACK": ("frames arrive again after a frame timeout.", _NOTHING),
    "FRAMES_MISSING": (
        "frames were lost in the camera or in transport, or the controller was delayed and skipped them.",
        "if frequent: `lowfc doctor`, a lower `camera.rate_hz`, dedicated processors for camera and controller.",
    ),
    "STREAM_SILENT": (
        "no process writes the ImageStreamIO stream, or its writer died during an image.",
        "start the writer; the driver resumes by itself.",
    ),
    "STREAM_RENEWED": (
        "another process recreated the camera's stream or the mirror's channel.",
        "nothing, unless the size of the camera's frames changed: then load a calibration of this size.",
    ),
    "CAMERA_RESTARTED": (
        "the camera's frame numbers restarted; frames are not used until its settings are received.",
        "nothing; if nobody restarted it, check the events of the camera's process.",
    ),
    "MIRROR_ADOPTED": ("the controller started while the mirror had a modal command.", _NOTHING),
    "SHAPE_ADOPTED": (
        "the mirror had a shape outside the modes, as after a restart of the controller.",
        "keep it if it is a dark hole; else `lowfc ctl channel adopted --zero`.",
    ),
    "FLAT_NOT_IN_FORCE": (
        "other channels had been set before the mirror's first report; added to them, the map of `mirror.flat` exceeds "
        "a limit.",
        "change these channels, then `lowfc ctl channel flat FILE`.",
    ),
    "LAW_NOT_IN_FORCE": (
        "the law of `control.law` was refused: no calibration of the law's modes is loaded, or the camera's settings "
        "do not fit the calibration.",
        "load a calibration of these modes for the camera's settings, or restore the camera's settings; then "
        "`lowfc ctl law FILE`.",
    ),
    "LAW_OVERRULED": (
        "the guard found that the law's residual exceeds the integrator's, or that the loop amplifies the disturbance.",
        "tune a law again from a recent log; `lowfc ctl law FILE`, or `open` and then `close`, reactivates it.",
    ),
    "LAW_BACK": (
        "the law, simulated on the same frames, had a far smaller residual than the integrator for some time.",
        _NOTHING,
    ),
    "NOTE": ("an operator wrote a note.", _NOTHING),
    "CLOSING_HARMS": (
        "at these gains, closing would increase the residual of some modes: by their noise, or by amplification.",
        "`lowfc ctl gain auto`, or lower gains of the modes that the event names.",
    ),
    "GAINS_CHANGED": ("automatic gains changed.", _NOTHING),
    "STAR_CHANGED": (
        "the flux changed by more than 20 % for half a second and at least 20 frames; automatic gains are lowered and "
        "measured again.",
        "nothing after a slew; else check for clouds, a vignetted beam or a changed exposure.",
    ),
    "LOOP_HARMS": (
        "in three windows in a row the closed loop's residual exceeded that of an open loop: gains too high for the "
        "noise, a wrong calibration, or a wrong delay.",
        "`lowfc ctl gain auto`; if the event is raised again, check calibration and `control.delay_frames`. With "
        "`control.on_harm` the loop can open by itself.",
    ),
    "PLAY_ENDED": (
        "a probe sequence ended early: the camera restarted, the mirror was lost, a calibration was loaded, no frame "
        "came in time, or a limit acted.",
        "remove the cause, and run the calibration or test again (with `--resume` if available).",
    ),
    "LEASE_TAKEN": ("a program reserved the loop.", "wait, or `lowfc ctl stop`, which ends the reservation."),
    "LEASE_RELEASED": ("the program has finished and released the loop.", _NOTHING),
    "LEASE_ENDED": (
        "the holder did not renew the reservation in time, the reserved time is over, or somebody requested safe, "
        "open, pause or stop.",
        "check that the program that held the reservation has stopped.",
    ),
    "INTERLOCK_ACTS": (
        "a bench value meets the condition of an interlock, or it is missing, too old or of another type (`when_old`).",
        "remove the cause, or check the publisher of the value.",
    ),
    "INTERLOCK_CLEARED": ("the condition no longer holds.", "close the loop again, if the interlock opened it."),
    "LOOP_STEPPED": (
        "the requested number of closed frames (`lowfc ctl step`) is complete; the loop is open.",
        "`lowfc ctl close`, if the residual fell.",
    ),
    "MIRROR_LOST": (
        "the mirror's process died, hangs, or does not follow. A closed loop returns its command to the last "
        "shape that the mirror confirmed, and holds it, so that the command does not wind up.",
        "check the mirror's process and its driver's events; restart it. The loop resumes by itself.",
    ),
    "MIRROR_BACK": ("the mirror follows again.", _NOTHING),
    "MIRROR_REFUSED": (
        "the mirror reports a grid that differs from the calibration, or values that are not finite.",
        "set `mirror.rows` and `mirror.columns`, or load the calibration of this mirror.",
    ),
    "LIMIT_HIT": (
        "a limit of the controller or the mirror clipped a command.",
        "see the [reasons](#reasons); a limit that acts briefly after closing is normal.",
    ),
    "LIMIT_CLEARED": ("the limit no longer acts.", _NOTHING),
    "COMMAND_EXPIRED": (
        "the mirror had no valid command for `control.command_timeout_ms`: the controller died, hangs, or lost its "
        "link. The mirror relaxes to flat or holds (`mirror.on_command_timeout`).",
        "restart the controller; it starts from the mirror's shape, in `control.start_mode`.",
    ),
    "COMMAND_BACK": ("the mirror follows commands again.", _NOTHING),
    "COMMAND_REFUSED": (
        "a command was not finite, of another grid, out of order, ahead of the clock, or on an unusable channel, or "
        "the driver had failed.",
        "see the [reasons](#reasons); if commands are out of order, find out which process commands this mirror "
        "(`lowfc hosts`): only one controller may.",
    ),
    "START_AHEAD": (
        "the clock of the sender's host is ahead by more than `control.max_start_ahead_h`.",
        "set the clocks of both hosts and start the sender again; if its frames are then OUT_OF_ORDER, see the "
        "[reasons](#reasons).",
    ),
    "LATCH_FAILED": (
        "a file that keeps safe mode across restarts cannot be read or written.",
        "make the directory named in the event writable; the loop mode does not change. A controller "
        "that cannot read such a file at its start is in safe mode; one that can write none of them starts open.",
    ),
    "COMMANDS_LATE": (
        "in the simulated camera, more than a quarter of the last 500 commands were applied after the next exposure "
        "had begun, and act a frame late.",
        "lower `camera.rate_hz`, or give the loop its processors and real-time rights (`lowfc doctor`); if the bench "
        "cannot be faster, set `control.delay_frames` to the measured delay.",
    ),
    "COMMANDS_IN_TIME": ("at most an eighth of the last 500 commands are late.", _NOTHING),
    "FRAMES_LOST": (
        "the camera's own frame numbers have gaps: frames were lost in the camera, its cable or its driver.",
        "check cable, bandwidth and packet size; a lower rate or a smaller region helps.",
    ),
    "DRIVER_FAILED": (
        "the driver raised an exception, or returned a frame that does not match its settings.",
        "see the cause in the event; the driver is retried automatically.",
    ),
    "DRIVER_HANGS": (
        "a call of the driver does not return.",
        "check the hardware; if it persists, restart the driver's process.",
    ),
    "DRIVER_BACK": ("the driver works again.", _NOTHING),
    "RECORDING": ("a log is being written.", _NOTHING),
    "RECORDING_STOPPED": ("the log is finished.", "`lowfc ctl record start` begins the next one."),
    "MESSAGES_LOST": (
        "the recorder did not receive or could not write messages of a topic; the event gives their number.",
        "give the recorder its own processor or a faster disk; `replay` names the steps that it cannot check.",
    ),
    "RECORDING_FAILED": (
        "the disk is nearly full, a write failed, or the folder is gone. A log is readable up to its last flush.",
        "free some space or restore the folder, then `lowfc ctl record start`; the loop continues without a log.",
    ),
    "DISK_SLOW": ("one write to the disk took long; messages waited in memory.", "use a faster or less busy disk."),
    "ON_EVENT_FAILED": (
        "the shell command of `recorder.on_event` failed or took more than 60 s.",
        "run the command by hand and correct it.",
    ),
    "VIEW_STUCK": ("the viewer's window reads no data.", "close the window if it hangs, and start `lowfc view` again."),
    "VIEW_RENEWED": (
        "the viewer hung, ended, failed to draw or exceeded its memory limit.",
        "reload the page in a browser; a window returns by itself.",
    ),
    "BAD_MESSAGE": (
        "a message could not be decoded or has an impossible time: its publisher is of another version, or faulty.",
        "find the publisher of the topic; `lowfc conformance` checks a camera or a mirror.",
    ),
}
"""Cause and remedy of each event."""

REASONS: dict[str, tuple[str, str]] = {
    "NO_CALIBRATION": ("no calibration is loaded", "load or measure one"),
    "WRONG_SIZE": ("rows, columns, encoding or bytes differ from the calibration", "set the camera's region"),
    "OUT_OF_ORDER": (
        "the frame or command is older than the newest one",
        "nothing, if rare; stop a second camera; if the camera's clock was set back, `lowfc ctl safe`, then `clear`",
    ),
    "REPEATED": ("the newest frame arrived again", "nothing, unless frequent"),
    "LATE": (
        "the frame's age is above `control.max_frame_age_ms`, or above both 5 ms and three periods; or a newer frame "
        "superseded it",
        "`lowfc doctor`; check the clocks of the hosts",
    ),
    "SATURATED": ("over `control.max_saturated_pixels` good pixels are at full well", "shorter exposure, lower gain"),
    "DARK": (
        "the flux is less than `control.min_flux_fraction` of the calibration's flux",
        "centre the star on the mask; for a fainter star `lowfc calibrate reference`, or a lower fraction",
    ),
    "NO_FRAME": ("no frame came in time", "as for NO_FRAMES"),
    "STUCK": ("the camera repeats the same image", "restart the camera"),
    "AHEAD": ("the sender's start time is too far ahead of this host's clock", "as for START_AHEAD"),
    "CAMERA_UNKNOWN": (
        "the camera restarted and its settings have not arrived",
        "nothing; they are sent twice a second",
    ),
    "NO_MIRROR": ("the mirror does not follow", "as for MIRROR_LOST"),
    "HELD": ("an interlock or a permit holds the loop", "wait, or remove the cause of the interlock"),
    "MODAL_LIMIT": (
        "a modal command reached its limit",
        "centre the star; offload; raise the limit with `lowfc ctl limit`",
    ),
    "STROKE": ("an actuator reached its stroke", "a better flat map, or smaller channels"),
    "SLEW": (
        "an actuator reached its slew limit in one command",
        "nothing, if the loop has just closed or been reset; else lower gains",
    ),
    "NEIGHBOUR": ("neighbouring actuators would differ by too much", "smaller channels; look for a stuck actuator"),
    "NOT_FINITE": ("a value was not finite; the previous command is kept", "check calibration and law"),
    "WRONG_GRID": ("the grid differs from the mirror's", "load the calibration of this mirror"),
    "CHANNEL": (
        "the name of a command's channel has more than 32 characters, or the channel would be the mirror's seventeenth",
        "a shorter name, or fewer programs that command this mirror",
    ),
    "LAW_OVERRULED": ("the integrator has taken over modes from the law", "as for LAW_OVERRULED"),
}
"""Cause and remedy of each rejection and limit, by its name on the wire without REASON_."""
