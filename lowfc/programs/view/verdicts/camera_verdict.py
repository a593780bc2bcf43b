"""Judgement on what comes from the camera: do frames arrive, are they used, is there light on them."""

from lowfc.contract.messages import FRAME, Role
from lowfc.control.loop.safety import Reason, Rejection
from lowfc.control.loop.wording import counted
from lowfc.programs.view.verdicts.tile import Level, Tile, ago, worst_of
from lowfc.programs.view.verdicts.watcher import GRACE_S, RECENT_S, SILENT_S, Liveness, Watcher

SLOW = 0.9
"""Frames at less than this share of the camera's own rate are a camera or host that does not keep up."""
FEW = 0.005
"""Fewer frames than this share, lost or refused, do no measurable harm: they are reported, no more."""
MANY_LOST = 0.1
"""Where a tenth of the frames is lost, the loop is no longer the one that was tuned."""
DARK, DIM, BRIGHT = 0.2, 0.5, 2.0
"""A fifth of the light is what a controller refuses as dark by default; half the light is 1.4 times the
noise; twice the light is not the star that was calibrated."""

REFUSED: dict[Reason, tuple[str, str]] = {
    Rejection.DARK: ("too dark", "the star is gone; look at pointing, shutter and clouds"),
    Rejection.SATURATED: ("detector saturated", "there is too much light; shorten the exposure or dim the star"),
    Rejection.WRONG_SIZE: ("wrong size", "they are not what was calibrated; set the camera back or calibrate again"),
    Rejection.LATE: ("too late", "host or link is too slow; look at the latency, lower the rate"),
    Rejection.NO_CALIBRATION: ("no calibration", "load a calibration"),
    Rejection.STUCK: ("stuck", "the camera sends one image again and again; restart it"),
    Rejection.REPEATED: ("repeated", "the camera sends a frame twice; restart it"),
    Rejection.OUT_OF_ORDER: ("out of order", "there may be a second camera on the bus; stop one"),
}
"""The reasons for which a frame is refused: in words, and what to do."""


def frames(watcher: Watcher) -> Tile:
    """Whether frames come, at their rate, and are used."""
    title, camera, silent_s = "FRAMES", watcher.process(Role.CAMERA), watcher.silent_s(FRAME)
    if camera.life is Liveness.NEVER:
        if watcher.running_s > GRACE_S:
            advice = "There is no camera. Start it for this run."
            return Tile(title, "NO CAMERA", "no message from it", Level.WARNING, advice)
        return Tile(title, "WAITING", "for the camera", Level.NEUTRAL)
    if camera.life in (Liveness.STOPPED, Liveness.STARTING):
        return Tile(title, camera.life.name, "the camera, on request", Level.NEUTRAL)
    if silent_s is not None:
        alive = camera.life is not Liveness.SILENT and silent_s > 2 * SILENT_S
        who = "the camera runs, but sends none" if alive else "camera silent"
        advice = f"No frame for {ago(silent_s)}, {who}: the loop holds. See the camera's last output, restart it."
        return Tile(title, "NO FRAMES", f"for {ago(silent_s)}: {who}", Level.BAD, advice)
    skipped, missing = watcher.recent("skipped"), watcher.recent("missing")
    refused = sum(watcher.recent(reason) for reason in REFUSED)
    nominal = RECENT_S * 1e9 / watcher.period_ns if watcher.period_ns else 0.0
    due = max(watcher.recent("steps") + skipped + missing, nominal, 1)
    return worst_of(
        (
            _rate(watcher, {"skipped": skipped, "never arrived": missing, "refused": refused}),
            _lost(skipped, missing, due),
            _refused(watcher, refused, due),
        )
    )


def _rate(watcher: Watcher, unused: dict[str, int]) -> Tile:
    title, rate_hz = "FRAMES", watcher.rate_hz()
    if rate_hz is None and watcher.now("steps"):
        return Tile(title, "STARTING", "too few for a rate", Level.NEUTRAL)
    if rate_hz is None:
        return Tile(title, "UNUSED", "frames arrive, no controller uses them", Level.NEUTRAL)
    value = f"{rate_hz:.0f} Hz" if rate_hz >= 10 else f"{rate_hz:.2g} Hz"
    nominal_hz = 1e9 / watcher.period_ns if watcher.period_ns else 0.0
    if rate_hz < SLOW * nominal_hz:
        advice = f"The camera runs at {rate_hz:.3g} Hz, not at {nominal_hz:.3g} Hz: the host does not keep up."
        return Tile(title, value, f"slow: {nominal_hz:.3g} Hz wanted", Level.WARNING, advice)
    few = ", ".join(f"{counted(count, 'frame')} {what}" for what, count in unused.items() if count)
    detail = f"{few} in the last {RECENT_S:g} s" if few else "none lost, none refused"
    return Tile(title, value, f"{detail}{', simulated time' if watcher.simulated else ''}", Level.GOOD)


def _lost(skipped: int, missing: int, due: float) -> Tile:
    share = (skipped + missing) / due
    parts = [f"{skipped} skipped (controller busy)"] * bool(skipped) + [f"{missing} never arrived"] * bool(missing)
    kinds = ", ".join(parts)
    advice = (
        f"{counted(skipped + missing, 'frame')} lost in the last {RECENT_S:g} s, {100 * share:.2g} %: {kinds}. "
        "Free the host's processors or lower the rate."
    )
    level = Level.BAD if share > MANY_LOST else Level.WARNING if share >= FEW else Level.NEUTRAL
    return Tile("FRAMES", f"{skipped + missing} LOST", f"{kinds}, in the last {RECENT_S:g} s", level, advice)


def _refused(watcher: Watcher, refused: int, due: float) -> Tile:
    every = all_refused(watcher)
    counts = {reason: watcher.now(reason) if every else watcher.recent(reason) for reason in REFUSED}
    word, what = REFUSED[max(counts, key=lambda one: counts[one])]
    if every:
        advice = f"Every frame is refused, {word}: {what}. The mirror holds."
        return Tile("FRAMES", "REFUSED", f"all: {word}", Level.BAD, advice)
    advice = f"{counted(refused, 'frame')} refused in the last {RECENT_S:g} s, {word}: {what}."
    level = Level.WARNING if refused >= FEW * due else Level.NEUTRAL
    return Tile("FRAMES", f"{refused} REFUSED", f"{word}, in the last {RECENT_S:g} s", level, advice)


def star(watcher: Watcher) -> Tile:
    """How much light there is, of what the calibration expects."""
    title, flux = "STAR", watcher.flux
    stopped = watcher.process(Role.CAMERA).life is Liveness.STOPPED
    if flux is None or (watcher.silent_s(FRAME) is not None and not stopped):
        return Tile(title, "?", "light not known now", Level.NEUTRAL)
    percent = 100 * flux
    value = f"{percent:.0f} %" if percent >= 1 else "< 1 %"
    detail = "of the expected light"
    if stopped:
        return Tile(title, f"last: {value}", detail, Level.NEUTRAL)
    full = f"{counted(watcher.saturated, 'pixel')} at full well"
    steps = watcher.now("steps")
    if watcher.now(Rejection.SATURATED) > steps / 2 and watcher.saturated:
        advice = f"The detector is saturated, {full}: shorten the exposure or dim the star."
        return Tile(title, "SATURATED", f"{full}; {value} {detail}", Level.BAD, advice)
    if (watcher.now(Rejection.DARK) > steps / 2 and flux < DIM) or (not steps and flux < DARK):
        advice = f"The star is gone, {value} of its light: look at pointing, shutter and clouds. The mirror holds."
        return Tile(title, "GONE", f"{value} {detail}", Level.BAD, advice)
    if watcher.saturated:
        advice = f"Near saturation, {full}: shorten the exposure."
        return Tile(title, value, f"{full}; {detail}", Level.WARNING, advice)
    if not DIM <= flux <= BRIGHT:
        word, what = ("dim", "look for clouds") if flux < DIM else ("bright", "is it the one that was calibrated?")
        advice = f"The star is {word}, {value} of the expected light: {what}."
        return Tile(title, value, f"{word}: {detail}", Level.WARNING, advice)
    return Tile(title, value, f"{detail}, no pixel saturated", Level.GOOD)


def all_refused(watcher: Watcher) -> bool:
    """Whether no frame of the last second was used."""
    steps = watcher.now("steps")
    return steps > 0 and sum(watcher.now(reason) for reason in REFUSED) >= steps
