"""What may come to a controller, in any order."""

import numpy as np
from hypothesis import strategies as st

from lowfc.contract.codecs.calibration_codec import identified
from lowfc.control.loop.inputs import CameraSettings, Input, MirrorShape, Request, Tick
from tests.support.toy import NOLL, calibration, frame

CALIBRATION = identified(calibration())
TIGHT = {"limit_nm": (15.0, 8.0), "max_saturated_pixels": 0, "max_identical_frames": 2}
"""Settings under which limits act."""


@st.composite
def inputs(draw: st.DrawFn) -> list[Input]:
    """Good and bad frames, gaps, silence, operators, devices."""
    taken: list[Input] = []
    count = 0
    for kind in draw(st.lists(st.sampled_from("fffffbltrmcs"), min_size=1, max_size=40)):
        seed = draw(st.integers(0, 1 << 16))
        rng = np.random.default_rng(seed)
        match kind:
            case "f":
                count += 1 + (seed % 7 == 0) * 3
                taken.append(frame(count, rng.normal(0, 20, len(NOLL))))
            case "b":
                bad: dict[str, object] = {"pixels": None} if seed % 2 else {"sequence": 5}
                count += 1
                taken.append(frame(count, **bad))
            case "l":
                count += 1
                taken.append(frame(count, age_ns=10**9))
            case "t":
                taken.append(Tick(seed, seed * 2_000))
            case "r":
                name = ("gain", "leak", "status", "open", "safe", "clear", "nonsense")[seed % 7]
                taken.append(Request(seed, name, (), (float(np.float32(rng.uniform(0, 1))),)))
            case "m":
                shape = rng.normal(0, 30, CALIBRATION.grid).astype(np.float32)
                taken.append(MirrorShape(seed, shape, rng.normal(0, 5, 3).astype(np.float32)))
            case "c":
                taken.append(CameraSettings(seed, CALIBRATION.shape, 7.0, CALIBRATION.saturation_dn))
            case "s":
                taken += [Request(seed, "clear"), Request(seed, "close")]
    return taken
