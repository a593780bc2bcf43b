"""Verdict on a run, in a few lines."""

from collections import Counter
from collections.abc import Mapping

from lowfc.contract.messages import CALIBRATION, STEP, Role
from lowfc.control.loop.wording import counted
from lowfc.programs.cli.correction import MANY_LATE, NEAR_STROKE, Correction, correction
from lowfc.programs.logs.report.source import Results

GOOD, LOOK, BAD, UNKNOWN = "good", "look", "bad", "unknown"
_LEVELS = {Correction.GOOD: GOOD, Correction.LITTLE: UNKNOWN, Correction.HARM: LOOK}

_MANY_WITHOUT_COMMAND = 0.01  # fraction of the frames


def verdict(results: Results) -> Results:
    """Checks, each with a level and a sentence; the overall level is the worst one."""
    parts = (_record, _modes, _residual, _commands, _delay, _frames, _mirror, _events)
    checks = [part(results) for part in parts]
    order = (GOOD, UNKNOWN, LOOK, BAD)
    level = max((check["level"] for check in checks), key=order.index)
    first = next((check["text"] for check in checks if check["level"] == level), "")
    heading = {
        GOOD: "A good run",
        UNKNOWN: "No fault found, but not all checks are good",
        LOOK: "To be checked",
        BAD: "Not a good run",
    }[level]
    return {"level": level, "heading": heading, "because": first if level != GOOD else "", "checks": checks}


def _check(name: str, level: str, text: str) -> Results:
    return {"name": name, "level": level, "text": text}


def _record(results: Results) -> Results:
    log = results["log"]
    faults = [f"recording stopped: {log['stopped']}"] if log["stopped"] else []
    if log["damage"]:
        faults.append(f"{counted(len(log['damage']), 'damaged part')} left out")
    if not log["finished"]:
        faults.append("truncated: the recorder did not finish it")
    if log["missing_files"]:
        faults.append(f"{counted(log['missing_files'], 'file')} missing between the first and the last")
    if log["recovery"]:
        faults.append(log["recovery"])
    if log["messages_lost"]:
        faults.append(f"{counted(log['messages_lost'], 'message')} lost")
    if log["steps_left_out"]:
        mismatch = "with another number of modes than the calibration or with impossible values"
        faults.append(f"{counted(log['steps_left_out'], 'message')} {mismatch}, left out")
    if faults:
        return _check("log", BAD if log["stopped"] else LOOK, "; ".join(faults))
    if log["messages_lost"] is None:
        return _check("log", UNKNOWN, "complete; lost messages were not counted")
    recorded = f"; recorded: {log['selection']}" if log["selection"] else ""
    return _check("log", GOOD, f"complete, no message lost{recorded}")


def _modes(results: Results) -> Results:
    steps = results["mode_steps"]
    if not (total := sum(steps.values())):
        return _check("loop", BAD, _why_no_loop(results["log"]["messages_by_topic"]))
    shares = ", ".join(f"{name} {count / total:.1%}" for name, count in steps.items())
    if steps.get("safe"):
        return _check("loop", BAD, f"the loop was in safe mode ({shares})")
    return _check("loop", GOOD if steps.get("closed") else UNKNOWN, shares)


def _why_no_loop(messages: Mapping[str, int]) -> str:
    """Reason why a report has no steps, from the number of messages by topic key."""
    if not (count := messages.get(STEP.key, 0)):
        return "this log has no control steps"
    if CALIBRATION.key not in messages:
        return f"this log has no calibration, without which its {counted(count, 'control step')} cannot be read"
    return f"this log has {counted(count, 'control step')}, but none fits its calibration"


def _residual(results: Results) -> Results:
    """Wavefront before and after correction: true over the open pupil if the log has truth, otherwise measured modes.

    The measured modes are also used if the true residual contains shapes of offset or channels, as the error has none.
    """
    totals, tilts = results["residual"]["total_rms_nm"], results["residual"]["tilt_mas"]
    shaped = totals["residual"] is not None and results["residual"]["shaped"]
    true = totals["residual"] is not None and not shaped
    before, after = ("disturbance", "residual") if true else ("pseudo_open_loop", "error")
    before_nm, after_nm = totals[before], totals[after]
    area = "in all modes over the circle"
    open_pupil = results["residual"]["open_pupil"]
    pupil_nm = [open_pupil[f"{name}_open_pupil_rms_nm"] for name in ("disturbance", "residual")]
    if true and all(pupil_nm):
        before_nm, after_nm = pupil_nm
        area = "over the open pupil"
    if before_nm is None or after_nm is None or not results["mode_steps"].get("closed"):
        why = results["error_budget"].get("why_not", "this log has no good closed-loop frame")
        return _check("residual", UNKNOWN, why)
    text = f"{before_nm:.3g} nm before, {after_nm:.3g} nm after correction {area}, in the longest stretch under one law"
    if tilts[before] and tilts[after]:
        text += f"; tip and tilt {tilts[before]['per_axis']:.3g} mas to {tilts[after]['per_axis']:.3g} mas per axis"
    text += f" ({'true' if true else 'measured, both with sensor noise'})"
    if shaped:
        shapes = "an offset or channels were in force, and their shapes are in the true residual"
        text += f"; {shapes} of {pupil_nm[1] or totals['residual']:.3g} nm"
    level = _LEVELS[correction(after_nm, before_nm)]
    return _check("residual", level, f"{text}; little is corrected" if level == UNKNOWN else text)


def _commands(results: Results) -> Results:
    frames = results["timing"]["frames"]
    without, recorded = frames["without_command"], frames["recorded"] - frames["at_the_end"]
    if not recorded:
        return _check("commands", UNKNOWN, "this log has no frames")
    if results["run"]["calibration"] is None:
        if results["log"]["messages_by_topic"].get(STEP.key) and not results["mode_steps"]:
            return _check("commands", UNKNOWN, "this log has no calibration, without which its steps cannot be read")
        return _check("commands", UNKNOWN, "this log has no calibration, without which frames lead to no command")
    if not without:
        return _check("commands", GOOD, f"all {recorded} frames were processed")
    share = without / recorded
    text = f"{without} of {recorded} frames ({share:.2%}) were not processed"
    return _check("commands", BAD if share >= _MANY_WITHOUT_COMMAND else LOOK, text)


def _delay(results: Results) -> Results:
    frames = results["timing"]["frames"]
    late, steps = frames["commands_late"], sum(results["mode_steps"].values())
    if late is None or not steps:
        return _check("delay", UNKNOWN, "this log does not show whether commands were in time")
    if late <= MANY_LATE * steps:
        return _check("delay", GOOD, f"{counted(late, 'command')} late")
    how_late = "after the start of the next exposure, and acted one frame later than the law expects"
    return _check("delay", LOOK, f"{counted(late, 'command')} came {how_late}")


def _frames(results: Results) -> Results:
    light = results["light"]
    faults = []
    if light["frames_refused"]:
        faults.append(f"{counted(light['frames_refused'], 'frame')} refused ({_with_counts(light['refused'])})")
    if light["frames_saturated"]:
        faults.append(f"{counted(light['frames_saturated'], 'used frame')} with saturated pixels")
    return _check("light", LOOK if faults else GOOD, "; ".join(faults) or "no frame refused, none saturated")


def _mirror(results: Results) -> Results:
    mirror = results["mirror"]
    limits = Counter(mirror["limits_at_mirror"]) | Counter(mirror["limits_at_controller"])  # the larger of both
    if limits:
        return _check("mirror", LOOK, f"limits acted: {_with_counts(limits)}")
    if (share := mirror["stroke_most_share"]) is None:
        return _check("mirror", UNKNOWN, "this log does not show the stroke used")
    text = f"at most {share:.1%} of the stroke used"
    return _check("mirror", LOOK if share > NEAR_STROKE else GOOD, text)


def _events(results: Results) -> Results:
    events = results["events"]
    grave = [event for event in events if event["level"] in ("error", "fatal")]
    warned = [event for k, event in enumerate(events) if event["level"] == "warning" and not _is_only_end(events[k:])]
    if not (worst := grave or warned):
        return _check("events", GOOD, "no warning, no error")
    names = _with_counts(Counter(sorted(event["name"] for event in worst)))
    kind = "error" if grave else "warning"
    return _check("events", BAD if grave else LOOK, f"{counted(len(worst), kind)}: {names}")


def _is_only_end(events: list[Results]) -> bool:
    """Whether the first of these events only reports the end of the frames, because the camera stopped for good."""
    names = [event["name"] for event in events if event["name"] != "STOPPED" or event["process"] == Role.CAMERA]
    return names[0] == "NO_FRAMES" and "STOPPED" in names and "FRAMES_BACK" not in names


def _with_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(counts).most_common())
