"""Chaos cases: faults of the camera's frames, and of the mirror."""

from lowfc.contract.configuration import Control
from lowfc.contract.envelope import count_of
from lowfc.programs.reliability.chaos.bench import ChaosBench
from lowfc.programs.reliability.chaos.case import LOST, case

FIRST = 600
"""Index of the first frame with the fault; by then the loop has been closed for a second."""
FAULTY_FRAMES = 250
"""Number of frames with the fault: one second at the default rate."""
MAX_FRAMES_LATE = 50
"""Largest delay of a frame, in frames."""

# Kind, fault of the frames, event, how many of the first faulty frames may be used, whether losses may be reported.
_KINDS = (
    ("lost", "10 % of the frames are not sent", "FRAMES_MISSING", FAULTY_FRAMES, True),
    ("duplicated", "each frame is sent twice", "REPEATED", FAULTY_FRAMES, True),
    ("reordered", "frames arrive in pairs, in reverse order", "OUT_OF_ORDER", FAULTY_FRAMES, True),
    ("late", "each frame arrives 1 to 50 frames late", "OUT_OF_ORDER", FAULTY_FRAMES, True),
    ("wrong-size", "frames of another size", "WRONG_SIZE", 0, False),
    ("truncated", "truncated messages", "WRONG_SIZE", 0, False),
    ("random", "random bytes", "WRONG_SIZE", 0, False),
    ("old-sequence", "sequence numbers from an hour ago", "OUT_OF_ORDER", 0, True),
    ("saturated", "all pixels at full well", "SATURATED", 0, False),
    ("dark", "the star vanishes and returns", "DARK", 0, False),
    ("hot-pixels", "a tenth of the pixels at full well", "SATURATED", 0, False),
    ("cosmic-rays", "a track of six pixels at full well in a fifth of the frames", "", FAULTY_FRAMES, False),
    ("stuck", "the same image repeated as new frames", "STUCK", Control().max_identical_frames, False),
)


def _await_faulty_frames(bench: ChaosBench) -> None:
    last = FIRST + FAULTY_FRAMES + MAX_FRAMES_LATE
    bench.wait(lambda: count_of(bench.newest_frame) >= last, f"frame {last}")


for _kind, _description, _reason, _used, _may_lose in _KINDS:
    _event = _reason if _reason in ("", "FRAMES_MISSING") else f"FRAMES_REFUSED frames refused: {_reason}"
    case(
        f"frames-{_kind}",
        _description,
        fault=_kind,
        expected=(_event,) if _event else (),
        allowed=LOST if _may_lose else (),
        is_bad=range(FIRST + _used, FIRST + FAULTY_FRAMES).__contains__ if _used < FAULTY_FRAMES else None,
    )(_await_faulty_frames)
case(
    "stuck-actuators",
    "dead and stuck actuators, whose wavefront the modes cannot correct",
    config={"mirror.dead": [500, 501], "mirror.stuck_nm": {"600": 80.0}},
)(_await_faulty_frames)
case(
    "saturating",
    "a disturbance beyond the modal limit of tip and tilt",
    config={"disturbance.preset": "step", "disturbance.scale": 6.0, "control.tilt_limit_nm": 20.0},
    expected=("LIMIT_HIT",),
)(_await_faulty_frames)
