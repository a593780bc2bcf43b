"""Hypothesis strategy for inputs of a controller in any order."""

import numpy as np
from hypothesis import strategies as st

from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.control.loop.inputs import CameraSettings, Input, MirrorShape, Request, Tick
from lowfc.control.loop.interlocks import Action, BenchReport, Interlock
from tests.support.toy import NOLL, calibration, frame

CALIBRATION = with_identity(calibration())
INTERLOCKS = (
    Interlock("mask", "equal", True, Action.HOLD, 1000),
    Interlock("mask", "different", "parked", Action.OPEN, 2000, acts_when_old=False),
    Interlock("pressure", "above", 3.0, Action.SAFE, 1000, acts_when_old=False),
)
TIGHT = {
    "limit_nm": (15.0, 8.0),
    "max_saturated_pixels": 0,
    "max_identical_frames": 2,
    "rate_hz": 1000.0,
    "interlocks": INTERLOCKS,
}
"""Settings under which limits and interlocks often act."""
_KINDS = (*["frame"] * 5, "bad", "late", "tick", "request", "mirror", "camera", "close", "bench", "permit", "play")


@st.composite
def inputs(draw: st.DrawFn) -> list[Input]:
    """Draw good, bad and late frames, gaps, ticks, requests, probe sequences, device states and bench values."""
    drawn: list[Input] = []
    count = 0
    for kind in draw(st.lists(st.sampled_from(_KINDS), min_size=1, max_size=40)):
        seed = draw(st.integers(0, 1 << 16))
        rng = np.random.default_rng(seed)
        match kind:
            case "frame":
                count += 1 + (seed % 7 == 0) * 3
                drawn.append(frame(count, rng.normal(0, 20, len(NOLL))))
            case "bad":
                bad: dict[str, object] = {"pixels": None} if seed % 2 else {"sequence": 5}
                count += 1
                drawn.append(frame(count, **bad))
            case "late":
                count += 1
                drawn.append(frame(count, age_ns=10**9))
            case "tick":
                drawn.append(Tick(seed, seed * 2_000))
            case "request":
                names = ("gain", "leak", "status", "open", "safe", "clear", "nonsense", "offset", "limit", "reset")
                name = names[seed % len(names)]
                drawn.append(Request(seed, name, (), (float(np.float32(rng.uniform(0, 1))),)))
            case "mirror":
                shape = rng.normal(0, 30, CALIBRATION.grid).astype(np.float32)
                drawn.append(MirrorShape(seed, shape, rng.normal(0, 5, 3).astype(np.float32)))
            case "camera":
                drawn.append(CameraSettings(seed, CALIBRATION.shape, 7.0, CALIBRATION.saturation_dn))
            case "bench":
                value = (True, False, "parked", "away", None)[seed % 5]
                drawn.append(BenchReport(seed, "mask", value, 0 if value is None else seed % 3000))
                if seed % 11 == 0:
                    drawn.append(BenchReport(seed, "pressure", seed / 10_000))
            case "permit":
                text, values = "moving the mask", (2**-8,) if seed % 2 else ()
                drawn.append(Request(seed, "permit", (), values, text, lease_id=1 + seed % 3))
            case "play":
                table = rng.normal(0, 3, (1 + seed % 9, len(NOLL))).astype(np.float32)
                drawn.append(Request(seed, "play", text="offset", table=table))
            case "close":
                drawn += [Request(seed, "clear"), Request(seed, "close")]
    return drawn
