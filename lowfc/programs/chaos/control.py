"""Chaos cases: gains, calibrations and clocks."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lowfc.adapters import calibration_file
from lowfc.adapters.instrument import settings
from lowfc.client import Client
from lowfc.contract.calibration_codec import identified
from lowfc.contract.errors import RequestRefusedError
from lowfc.contract.messages import Role
from lowfc.control.calibration import Calibration
from lowfc.control.stability import limiting_gain
from lowfc.programs.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.chaos.host import read_only_view
from lowfc.programs.chaos.processes import kill_and_restart

JUST_BELOW = 0.9
WHILE_FRAMES = 250


def highest_gain(bench: ChaosBench) -> None:
    """Ask for a gain above the limit of stability, then for one just below it, then for the usual ones."""
    client, limiting = bench.client(), limiting_gain(settings(bench.config).delay_frames)
    try:
        client.gain(1.01 * limiting)
    except RequestRefusedError:
        pass
    else:
        raise CaseFailedError(f"a gain of {1.01 * limiting:.3g} was granted, where {limiting:.3g} is unstable")
    client.gain(JUST_BELOW * limiting)
    bench.frames(WHILE_FRAMES)
    client.gain(bench.config.control.gain)
    client.gain(bench.config.control.tilt_gain, modes=[2, 3])
    bench.settled()


def _good(bench: ChaosBench) -> Calibration:
    return calibration_file.load(bench.run.path / "calibration.fits")


def reversed_calibration(bench: ChaosBench) -> None:
    """Drive the loop away with a reconstructor of the other sign; safe it; go on with the right one."""
    client, good = bench.client(), _good(bench)
    client.open()
    client.load(identified(replace(good, reconstructor=-good.reconstructor)))
    client.close_loop()
    bench.frames(WHILE_FRAMES)
    client.safe()
    bench.frames(WHILE_FRAMES)
    client.clear()
    client.load(good)
    client.close_loop()
    bench.settled()


def foreign_calibration(bench: ChaosBench) -> None:
    """Load a calibration for smaller frames; go on with the right one."""
    client, good = bench.client(), _good(bench)
    rows, columns = good.shape
    kept = np.arange(rows * columns).reshape(rows, columns)[1:, 1:].ravel()
    foreign = replace(
        good,
        shape=(rows - 1, columns - 1),
        reference=good.reference[kept],
        response=good.response[kept],
        reconstructor=np.ascontiguousarray(good.reconstructor[:, kept]),
        good=good.good[kept],
        dark=good.dark[kept],
    )
    client.open()
    client.load(identified(foreign))
    bench.frames(WHILE_FRAMES)
    client.load(good)
    client.close_loop()
    bench.settled()


def damaged_calibration(bench: ChaosBench) -> None:
    """Kill the controller; start it with NaN in its calibration, which it refuses; start it with a good one."""
    path = bench.run.path / "damaged.fits"
    content = bytearray((bench.run.path / "calibration.fits").read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4] = np.array([np.nan], ">f4").tobytes()
    path.write_bytes(content)
    bench.kill(Role.CONTROLLER)
    good = bench.children[Role.CONTROLLER].command
    bench.restart(Role.CONTROLLER, lambda words: [*words[:-1], str(path)])
    if bench.ends(Role.CONTROLLER) != 2:
        raise CaseFailedError("the controller did not refuse a damaged calibration")
    if "damaged" not in bench.children[Role.CONTROLLER].last_words():
        raise CaseFailedError(f"it did not say what is wrong: {bench.children[Role.CONTROLLER].last_words()}")
    bench.restart(Role.CONTROLLER, lambda words: good)
    bench.wait(lambda: bench.heard(Role.CONTROLLER), "the controller")
    bench.settled()


def safed_restart(bench: ChaosBench) -> None:
    """Safe the loop, kill the controller and start it anew: it stays safed, and the mirror flat."""
    bench.client().safe()
    bench.frames(WHILE_FRAMES)
    kill_and_restart(bench, Role.CONTROLLER)
    bench.frames(WHILE_FRAMES)


def safe_without_directory(bench: ChaosBench) -> None:
    """Take the run's directory away, safe the loop, kill the controller while the latch is not in it, start it anew."""
    path = bench.run.path
    aside = path.with_name(f"{path.name}.aside")
    client = bench.client()
    path.rename(aside)
    try:
        _safe_and_kill(bench, client)
    finally:
        aside.rename(path)
    _start_anew(bench)


def safe_in_read_only_directory(bench: ChaosBench) -> None:
    """Make the run's directory read-only, join and safe the loop, kill the controller and start it anew."""
    with read_only_view(bench.run.path):
        _safe_and_kill(bench, bench.client())
    _start_anew(bench)


def _safe_and_kill(bench: ChaosBench, client: Client) -> None:
    client.safe()
    bench.frames(WHILE_FRAMES)
    bench.kill(Role.CONTROLLER)


def _start_anew(bench: ChaosBench) -> None:
    bench.restart(Role.CONTROLLER)
    bench.wait(lambda: bench.heard(Role.CONTROLLER), "the controller started anew")
    bench.frames(WHILE_FRAMES)


def other_clock(seconds: int) -> Callable[[ChaosBench], None]:
    """Let a camera with another clock take the camera's place for a while."""

    def act(bench: ChaosBench) -> None:
        usual = bench.children[Role.CAMERA].command
        bench.kill(Role.CAMERA)
        bench.restart(Role.CAMERA, lambda words: ["unshare", "--time", "--monotonic", str(seconds), *words])
        bench.wait(lambda: bench.heard(Role.CAMERA), "the camera with another clock")
        bench.frames(WHILE_FRAMES)
        bench.kill(Role.CAMERA)
        bench.restart(Role.CAMERA, lambda words: usual)
        bench.wait(lambda: bench.heard(Role.CAMERA), "the camera")
        bench.settled()

    return act
