"""Verdict on the camera: whether frames arrive and are used, and how much light there is."""

from collections.abc import Iterable
from functools import partial

from lowfc.control.loop.safety import Reason, Rejection
from lowfc.control.loop.wording import counted, hertz
from lowfc.programs.view.verdicts.run_state import RECENT_S, Liveness, RunState
from lowfc.programs.view.verdicts.tile import Level, Tile, absent, duration, worst_of

SLOW = 0.9
"""Measured rate as a fraction of the camera's nominal rate, below which camera or host does not keep up."""
FEW = 0.005
"""Fraction of frames lost or refused below which no harm is measurable: they are reported without a warning."""
MANY_LOST = 0.1
"""Fraction of frames lost above which the loop no longer behaves as tuned."""
DARK, DIM, BRIGHT = 0.2, 0.5, 2.0
"""Fractions of the expected light. Below a fifth of it, the controller refuses frames by default; at half of it, the
photon noise of the modes is 1.4 times larger; with more than twice as much, the star is not the calibrated one."""
HEALTH_OVERDUE_S = 4.0
"""Time without a frame after which a camera that does not count as silent certainly runs: a dead one would by then."""

REFUSED: dict[Reason, tuple[str, str]] = {
    Rejection.DARK: ("too dark", "the star is gone; check pointing, shutter and clouds"),
    Rejection.SATURATED: ("detector saturated", "too much light; shorten the exposure or dim the star"),
    Rejection.WRONG_SIZE: ("wrong size", "frame and calibration differ in size; reset the camera or calibrate again"),
    Rejection.LATE: (
        "too late",
        "host or link is too slow, or the hosts' clocks differ; see `lowfc doctor`, lower the rate",
    ),
    Rejection.NO_CALIBRATION: ("no calibration", "load a calibration"),
    Rejection.STUCK: ("stuck", "the camera repeats one image; restart it"),
    Rejection.REPEATED: ("repeated", "the camera sends a frame twice; restart it"),
    Rejection.OUT_OF_ORDER: ("out of order", "there may be a second camera in the run; stop one"),
    Rejection.AHEAD: ("camera clock ahead", "set the clocks of both hosts and restart the camera"),
    Rejection.CAMERA_UNKNOWN: ("camera settings unknown", "the camera restarted; restart it if they stay unknown"),
    Rejection.NO_MIRROR: ("no mirror", "the mirror does not follow; check it"),
    Rejection.HELD: ("loop held", "an interlock or a permit holds the loop"),
}
"""Reasons for refusing a frame: text and advice."""
_IF_ALL: dict[Reason, str] = {
    Rejection.OUT_OF_ORDER: "a clock was set back, or there is a second camera; stop that camera, or `lowfc ctl safe` "
    "and then `lowfc ctl clear`, which flatten the mirror"
}
"""Advice if every frame is refused, where it differs from the advice in `REFUSED`."""
_FRAME_REASONS = [reason for reason in REFUSED if reason not in (Rejection.NO_MIRROR, Rejection.HELD)]
"""Reasons for which the tile FRAMES may say REFUSED; the tile LOOP reports the others."""


def frames(state: RunState) -> Tile:
    """Tile FRAMES: whether frames arrive at the nominal rate and are used."""
    tile, camera, silent_s = partial(Tile, "FRAMES"), state.camera, state.frame_silent_s
    controller = state.snapshot.controller
    relaxes = controller is not None and controller.settings.on_frame_timeout == "flat"
    effect = "the mirror relaxes to flat" if relaxes else "the loop holds"
    gone = absent("FRAMES", "camera", camera, state.running_s, effect)
    if gone is not None and camera.life is not Liveness.SILENT:  # a silent one is reported below
        return gone
    if camera.life is Liveness.STARTING:
        return tile("STARTING", "the camera")
    if silent_s is not None:
        alive = camera.life is not Liveness.SILENT and silent_s > HEALTH_OVERDUE_S
        cause = "the camera runs, but sends none" if alive else "camera silent"
        since = duration(silent_s)
        advice = f"No frame for {since}, {cause}: {effect}. Check what its process printed last, and restart it."
        return tile("NO FRAMES", f"for {since}: {cause}", Level.BAD, advice)
    lost = state.recent["skipped"] + state.recent["missing"]
    period_ns = state.snapshot.period_ns
    nominal_hz = 1e9 / period_ns if period_ns else 0.0
    expected = max(state.recent["steps"] + lost, RECENT_S * nominal_hz, 1)
    return worst_of((_rate(state, nominal_hz), _lost(state, lost, expected), _refused(state, expected)))


def _rate(state: RunState, nominal_hz: float) -> Tile:
    tile, rate_hz = partial(Tile, "FRAMES"), state.rate_hz
    if rate_hz is None:
        if state.now["steps"]:
            return tile("STARTING", "too few frames for a rate")
        return tile("UNUSED", "frames arrive, but no controller uses them")
    value = hertz(rate_hz)
    if rate_hz < SLOW * nominal_hz:
        advice = f"The camera runs at {rate_hz:.3g} Hz, not at {nominal_hz:.3g} Hz: camera or host does not keep up."
        return tile(value, f"slow: nominal {nominal_hz:.3g} Hz", Level.WARNING, advice)
    unused = {"skipped": state.recent["skipped"], "never arrived": state.recent["missing"]}
    unused["refused"] = sum(state.recent[reason] for reason in REFUSED)
    named = ", ".join(f"{counted(count, 'frame')} {what}" for what, count in unused.items() if count)
    detail = f"{named} {state.lately}" if named else "none lost, none refused"
    return tile(value, f"{detail}{', simulated time' if state.simulated else ''}", Level.GOOD)


def _lost(state: RunState, lost: int, expected: float) -> Tile:
    kinds = {"skipped (controller busy)": state.recent["skipped"], "never arrived": state.recent["missing"]}
    named = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
    advice = f"{counted(lost, 'frame')} lost {state.lately}, {100 * lost / expected:.2g} %: {named}. "
    level = Level.BAD if lost > MANY_LOST * expected else Level.WARNING if lost >= FEW * expected else Level.NEUTRAL
    advice += "Free the host's processors or lower the rate."
    return Tile("FRAMES", f"{lost} LOST", f"{named}, {state.lately}", level, advice)


def _refused(state: RunState, expected: float) -> Tile:
    all_frames, refused = all_refused(state, _FRAME_REASONS), sum(state.recent[reason] for reason in _FRAME_REASONS)
    commonest = max(_FRAME_REASONS, key=lambda reason: (state.now if all_frames else state.recent)[reason])
    word, advised = REFUSED[commonest]
    if all_frames:
        advice = f"Every frame is refused, {word}: {_IF_ALL.get(commonest, advised)}. The mirror holds."
        return Tile("FRAMES", "REFUSED", f"all: {word}", Level.BAD, advice)
    remedy = advised if state.now[commonest] else "it has ended"
    advice = f"{counted(refused, 'frame')} refused {state.lately}, {word}: {remedy}."
    level = Level.WARNING if refused >= FEW * expected else Level.NEUTRAL
    return Tile("FRAMES", f"{refused} REFUSED", f"{word}, {state.lately}", level, advice)


def star(state: RunState) -> Tile:
    """Tile STAR: light on the sensor, as a fraction of the light that the calibration expects."""
    tile, flux, stopped = partial(Tile, "STAR"), state.flux, state.camera.life is Liveness.STOPPED
    if flux is None or (state.frame_silent_s is not None and not stopped):
        return tile("?", "light unknown")
    value, detail = f"{100 * flux:.0f} %" if flux >= 0.01 else "< 1 %", "of the expected light"
    if stopped:
        return tile(f"last: {value}", detail)
    full, steps = f"{counted(state.saturated, 'pixel')} at full well", state.now["steps"]
    if state.now[Rejection.SATURATED] > steps / 2 and state.saturated:
        advice = f"The detector is saturated, {full}: shorten the exposure or dim the star."
        return tile("SATURATED", f"{full}; {value} {detail}", Level.BAD, advice)
    if (state.now[Rejection.DARK] > steps / 2 and flux < DIM) or (not steps and flux < DARK):
        advice = f"The star is gone, {value} of its light: check pointing, shutter and clouds. The mirror holds."
        return tile("GONE", f"{value} {detail}", Level.BAD, advice)
    if state.saturated:
        advice = f"Near saturation, {full}: shorten the exposure."
        return tile(value, f"{full}; {detail}", Level.WARNING, advice)
    if not DIM <= flux <= BRIGHT:
        word, advised = (
            ("dim", "check for clouds") if flux < DIM else ("bright", "check that it is the calibrated star")
        )
        return tile(value, f"{word}: {detail}", Level.WARNING, f"The star is {word}, {value} {detail}: {advised}.")
    return tile(value, f"{detail}, no pixel saturated", Level.GOOD)


def all_refused(state: RunState, reasons: Iterable[Reason] = REFUSED) -> bool:
    """Whether all frames of the last second were refused, for any of these reasons."""
    steps = state.now["steps"]
    return steps > 0 and sum(state.now[reason] for reason in reasons) >= steps
