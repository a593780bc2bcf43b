"""Chaos cases: gains, laws, calibrations, safe mode, interlocks and clocks."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lowfc.adapters.files import calibration_file
from lowfc.adapters.files.factory import settings
from lowfc.client import Client
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import FIXED_GAINS
from lowfc.contract.errors import RequestRefusedError
from lowfc.contract.messages import Role
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.stability import limiting_gain
from lowfc.control.loop.guard import MIN_BLOCK_FRAMES, WORSE_BLOCKS
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.programs.reliability.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.reliability.chaos.case import HOLD_FRAMES, LOST, case, no_clock_shift, no_mounts, read_only
from lowfc.programs.reliability.chaos.processes import kill_and_restart

STABLE_FRACTION = 0.9
"""Fraction of the limiting gain at which the loop is stable but nearly oscillates."""


@case("gain", "a gain above the stability limit, which is refused; then 90 % of the limit")
def _highest_gain(bench: ChaosBench) -> None:
    client, limiting = bench.client(), limiting_gain(settings(bench.config).delay_frames)
    with contextlib.suppress(RequestRefusedError):
        client.gain(1.01 * limiting)
        raise CaseFailedError(f"a gain of {1.01 * limiting:.3g} was accepted, above the limit of {limiting:.3g}")
    client.gain(STABLE_FRACTION * limiting)
    bench.await_steps(HOLD_FRAMES)
    client.gain(FIXED_GAINS["control.gain"])
    client.gain(FIXED_GAINS["control.tilt_gain"], modes=[2, 3])


@case(
    "law-that-fails",
    "a stable law with a gain near zero; the integrator takes over",
    expected=("LAW_OVERRULED the integrator takes over tip and tilt",),
)
def _law_that_fails(bench: ChaosBench) -> None:
    noll, loop = bench.config.noll, settings(bench.config)
    weak = integrator((0.002,) * len(noll), (0.0,) * len(noll), noll, loop.delay_frames, loop.rate_hz)
    bench.client().law(weak)
    bench.await_steps(SETTLING_FRAMES + FADING_FRAMES + (WORSE_BLOCKS + 2) * MIN_BLOCK_FRAMES)


def _calibration(bench: ChaosBench) -> Calibration:
    return calibration_file.load(bench.run.path / "calibration.fits")


def _load_and_close(bench: ChaosBench, calibration: Calibration) -> None:
    client = bench.client()
    client.load(calibration)
    bench.await_steps(1)  # the loop closes only on frames that it can use
    client.close_loop()


@case(
    "reversed-calibration",
    "a calibration with the sign of R reversed: the loop diverges; the operator requests `safe`",
    expected=("SAFED",),
)
def _reversed_calibration(bench: ChaosBench) -> None:
    client, good = bench.client(), _calibration(bench)
    client.open_loop()
    _load_and_close(bench, with_identity(replace(good, reconstructor=-good.reconstructor)))
    bench.await_steps(HOLD_FRAMES)
    client.safe()
    bench.await_steps(HOLD_FRAMES)
    client.clear()
    _load_and_close(bench, good)


@case(
    "foreign-calibration",
    "a calibration for frames of another size",
    expected=("FRAMES_REFUSED frames refused: WRONG_SIZE",),
)
def _foreign_calibration(bench: ChaosBench) -> None:
    client, good = bench.client(), _calibration(bench)
    rows, columns = good.shape
    cropped = np.arange(rows * columns).reshape(rows, columns)[1:, 1:].ravel()
    foreign = replace(
        good,
        shape=(rows - 1, columns - 1),
        reference=good.reference[cropped],
        response=good.response[cropped],
        reconstructor=np.ascontiguousarray(good.reconstructor[:, cropped]),
        good=good.good[cropped],
        dark=good.dark[cropped],
    )
    client.open_loop()
    client.load(with_identity(foreign))
    bench.await_steps(HOLD_FRAMES)
    _load_and_close(bench, good)


@case(
    "damaged-calibration",
    "a controller whose calibration file has a NaN ends at its start; then it is started with a good file",
    expected=("STARTED controller",),
    statuses={Role.CONTROLLER: 2},
)
def _damaged_calibration(bench: ChaosBench) -> None:
    path = bench.run.path / "damaged.fits"
    content = bytearray((bench.run.path / "calibration.fits").read_bytes())
    first = content.index(_calibration(bench).reconstructor.astype(">f4").tobytes())
    content[first : first + 4] = np.array([np.nan], ">f4").tobytes()
    path.write_bytes(content)
    bench.kill(Role.CONTROLLER)
    good = bench.children[Role.CONTROLLER].command
    bench.restart(Role.CONTROLLER, [*good[:-1], str(path)], ready=False)
    stderr_tail = bench.await_end(Role.CONTROLLER, 2)
    if "damaged" not in stderr_tail:
        raise CaseFailedError(f"the controller should have named the damaged calibration, got: {stderr_tail}")
    bench.restart(Role.CONTROLLER, good)


@case("safed-restart", "safe mode, then the controller is killed and restarted", expected=("SAFED",), ends_safe=True)
def _restart_in_safe_mode(bench: ChaosBench) -> None:
    bench.client().safe()
    bench.await_steps(HOLD_FRAMES)
    kill_and_restart(bench, Role.CONTROLLER)


INTERLOCK = {"name": "mask", "value": True, "action": "hold", "max_age_s": 1.0, "when_old": "passes"}
FLIPS, FLOOD_VALUES, FLOOD_HZ = 40, 4000, 2000  # changes of the value, then values in a flood, and their rate


@case(
    "interlock",
    "an interlock's value changes at random times, then is sent 2,000 times a second; the last value acts until it "
    "expires",
    config={"interlocks": [INTERLOCK]},
    expected=("INTERLOCK_ACTS", "INTERLOCK_CLEARED"),
)
def _interlock(bench: ChaosBench) -> None:
    client = bench.client()
    for flip in range(FLIPS):
        client.bench("mask", flip % 2 == 0)
        bench.pause(0, 0.02)
    begun_s = time.monotonic()
    for number in range(FLOOD_VALUES):
        client.bench("mask", False)
        if number > (time.monotonic() - begun_s) * FLOOD_HZ:
            time.sleep(0.01)
    client.bench("mask", True)
    bench.wait(lambda: bool(_acting(client)), "the interlock to act")
    bench.wait(lambda: not _acting(client), "the interlock's value to expire")


def _acting(client: Client) -> list[str]:
    """Reasons of the interlocks that act now."""
    state = client.status().state
    return [] if state is None else [interlock.why for interlock in state.interlocks_acting]


@contextlib.contextmanager
def _moved_away(folder: Path) -> Iterator[None]:
    """Rename a folder within the context."""
    aside = folder.rename(folder.with_name(f"{folder.name}.aside"))
    try:
        yield
    finally:
        aside.rename(folder)


def _safe_without_latch(no_latch: Callable[[Path], contextlib.AbstractContextManager[None]], bench: ChaosBench) -> None:
    """Enter safe mode and kill the controller while the run's directory cannot hold the latch; then restart it."""
    client = bench.client()
    with no_latch(bench.run.path):
        client.safe()
        bench.await_steps(HOLD_FRAMES)
        bench.kill(Role.CONTROLLER)
    bench.restart(Role.CONTROLLER)


no_latch_case = partial(case, expected=("SAFED", "LATCH_FAILED"), ends_safe=True)
no_latch_case(
    "safe-without-directory",
    "safe mode while the run's directory is missing; then the controller is killed and restarted",
)(partial(_safe_without_latch, _moved_away))
no_latch_case(
    "safe-read-only",
    "safe mode while the run's directory is read-only; then the controller is killed and restarted",
    why_skipped=no_mounts,
)(partial(_safe_without_latch, read_only))


def _other_clock(bench: ChaosBench, shift_s: int) -> None:
    """Replace the camera by one whose clock is ahead by `shift_s`, then by one with the host's clock."""
    normal = bench.children[Role.CAMERA].command
    for command in (["unshare", "--time", "--monotonic", str(shift_s), *normal], normal):
        bench.kill(Role.CAMERA)
        bench.restart(Role.CAMERA, command)
        if command is not normal:
            bench.await_steps(HOLD_FRAMES)


for _kind, _shift_s, _expected in (("ahead", 3600, ("CAMERA_RESTARTED",)), ("behind", -3600, ())):
    case(
        f"clock-{_kind}",
        f"a camera whose clock is an hour {_kind} replaces the camera for a while",
        expected=_expected,
        allowed=LOST,
        why_skipped=partial(no_clock_shift, _shift_s),
    )(partial(_other_clock, shift_s=_shift_s))
