"""The cost of recording: a real recorder on a real bus, fed with a loop's messages at the loop's rate."""

import contextlib
import json
import os
import platform
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import psutil
import typer

from lowfc.adapters.process.terminal import Json
from lowfc.contract.errors import BusError, DataFileError, raised_as
from lowfc.programs.cli.output import print_result

RATES_HZ = (1000.0, 2000.0, 5000.0)

_READY_S = 30.0  # longest wait until the recorder is ready
_STOP_S = 60.0  # longest wait until the recorder has stopped
_POLL_S = 0.5
_WARM_UP_S = 0.5  # time with traffic before the measurement
_COPY_S = 0.5  # duration of the copying that is timed
_COPY_BYTES = 256 * 1024  # buffer of the copied file
_RECORDER_KEYS = ("messages_recorded", "messages_lost", "longest_wait_ms", "longest_unflushed_ms", "longest_write_ms")
"""Values that the recorder prints at its end."""


def bench_record(
    seconds: Annotated[float, typer.Option(min=0.5, max=3600, help="Seconds of measurement at each rate.")] = 5.0,
    rate: Annotated[
        list[float] | None,
        typer.Option(min=10, max=20_000, help="Frames per second; may be repeated. Default: 1000, 2000 and 5000."),
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Folder on the disk to measure; default: the system's temporary folder.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure the cost of recording: processor time, losses and stalls of a recorder with the traffic of a loop.

    The recorder is a separate process; it receives the messages of camera, controller and mirror for every frame (frame
    of 80 x 80, command, step, mirror state, truth), with timing and health, over the real bus. Its processor share is
    compared with that of copying the same payloads to the same disk.

    Example: lowfc bench record --seconds 5 --json
    """
    with raised_as(DataFileError, OSError, f"{folder or tempfile.gettempdir()} cannot be written"):
        results = measure(tuple(rate or RATES_HZ), seconds, folder)
    print_result(results, render(results), as_json=as_json)


def measure(rates_hz: tuple[float, ...], seconds: float, folder: Path | None = None) -> dict[str, Any]:
    """Record at each rate for `seconds`, into a temporary folder within `folder`.

    Returns:
        host, payload_bytes_per_frame, copy_us_per_frame (processor time of copying the payloads) and rates. For each
        rate: rate_hz (requested) and offered_hz (sent); seconds; cpu_share (of one processor) and publisher_cpu_share;
        ratio (cpu_share over that of copying); messages_published; messages_recorded and messages_lost as counted by
        the recorder; log_bytes; and three durations: longest_wait_ms (from a message's arrival until it is written),
        longest_unflushed_ms (from arrival until it survives a kill -9) and longest_write_ms (one write to the disk).

    Raises:
        BusError: the recorder did not become ready, or failed.
    """
    from rich.console import Console

    from lowfc.adapters.process.progress import passing_bar

    rates: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="lowfc-bench-", dir=folder) as name:
        copy_us, frame_bytes = _copy_cost(Path(name))
        with passing_bar(Console(stderr=True)) as bar:
            task = bar.add_task("recording", total=len(rates_hz))
            for rate_hz in rates_hz:
                bar.update(task, description=f"recording at {rate_hz:g} Hz")
                results = _one_rate(rate_hz, seconds, Path(name))
                rates.append(results | {"ratio": results["cpu_share"] / (copy_us * 1e-6 * results["offered_hz"])})
                bar.advance(task)
    return {
        "rates": rates,
        "payload_bytes_per_frame": frame_bytes,
        "copy_us_per_frame": copy_us,
        "host": {"machine": platform.machine(), "processors": os.cpu_count(), "python": platform.python_version()},
    }


def render(results: dict[str, Any]) -> str:
    """The result of `measure` as a table."""
    lines = [f"{'loop':>8} {'processor':>10} {'x copying':>11} {'messages':>9} {'lost':>6} {'longest wait':>13} "
             f"{'unflushed':>10} {'write':>9}"]  # fmt: skip
    lines += [
        f"{rate['offered_hz']:>5.0f} Hz {100 * rate['cpu_share']:>8.1f} % {rate['ratio']:>9.1f} x "
        f"{rate['messages_published']:>9} {rate['messages_lost']:>6} {rate['longest_wait_ms']:>10.0f} ms "
        f"{rate['longest_unflushed_ms']:>7.0f} ms {rate['longest_write_ms']:>6.1f} ms"
        for rate in results["rates"]
    ]
    lines.append(
        "Processor: share of one processor that the recorder uses; x copying: this share / that of copying a frame's "
        f"{results['payload_bytes_per_frame']:.0f} bytes to the same disk ({results['copy_us_per_frame']:.1f} us). "
        "Longest wait: from a message's arrival until it is written; unflushed: until it survives a kill -9; write: "
        "one write to the disk."
    )
    return "\n".join(lines)


def _one_rate(rate_hz: float, seconds: float, folder: Path) -> dict[str, Any]:
    """Record at one rate; return the results of `measure` for this rate, without `ratio`."""
    from lowfc.adapters.bus.run import new_run_id, open_run
    from lowfc.programs.launch.processes import program
    from lowfc.programs.measure.traffic import Traffic

    run = open_run(new_run_id())
    arguments = ["-m", "lowfc", "record", "--run", run.run_id, "--folder", str(folder), "--json"]
    recorder = program("recorder", arguments, folder / "recorder.stderr")
    recorder.stdout_path = folder / "recorder.json"
    with contextlib.ExitStack() as stack:
        stack.callback(run.remove)
        recorder.start()
        stack.callback(recorder.stop, _STOP_S)  # no effect if it has ended
        traffic = stack.enter_context(contextlib.closing(Traffic(run, rate_hz)))
        deadline_s = time.monotonic() + _READY_S
        while not traffic.wait_for("recorder", _POLL_S):
            if recorder.status is not None or time.monotonic() > deadline_s:
                raise BusError(f"the recorder did not become ready: {recorder.stderr_tail()}")
        traffic.run(_WARM_UP_S)
        assert recorder.process is not None  # noqa: S101  # it was started
        process = psutil.Process(recorder.process.pid)
        begun_s, first_frame = time.monotonic(), traffic.frames
        own_begun_s, before = time.process_time(), process.cpu_times()
        traffic.run(seconds)
        elapsed_s = time.monotonic() - begun_s
        own_s, after = time.process_time() - own_begun_s, process.cpu_times()
        traffic.finish()
        recorder.stop(_STOP_S)
        if recorder.status:
            raise BusError(f"the recorder failed: {recorder.exit_description()}; {recorder.stderr_tail()}")
    printed = json.loads(recorder.stdout_path.read_bytes())
    return {
        "rate_hz": rate_hz,
        "offered_hz": (traffic.frames - first_frame) / elapsed_s,
        "seconds": elapsed_s,
        "cpu_share": (after.user + after.system - before.user - before.system) / elapsed_s,
        "publisher_cpu_share": own_s / elapsed_s,
        "messages_published": traffic.messages,
        "log_bytes": _remove([Path(log) for log in printed["logs"]]),
        **{name: printed[name] for name in _RECORDER_KEYS},
    }


def _remove(logs: list[Path]) -> int:
    """Remove the logs of a recording, which may be several; return their total size, bytes."""
    size = sum(log.stat().st_size for log in logs)
    for log in logs:
        log.unlink()
    return size


def _copy_cost(folder: Path) -> tuple[float, float]:
    """Processor time of copying one frame's payloads to a file, us, and their size, bytes."""
    from lowfc.programs.measure.traffic import frame_payloads

    frames = frame_payloads()
    path = folder / "copy"
    copied = 0
    with path.open("wb", buffering=_COPY_BYTES) as file:
        begun_s, end_s = time.process_time(), time.monotonic() + _COPY_S
        while time.monotonic() < end_s:
            for payloads in frames:
                for payload in payloads:
                    file.write(payload)
            copied += len(frames)
        file.flush()
        used_s = time.process_time() - begun_s
    path.unlink()
    size = sum(len(payload) for payloads in frames for payload in payloads)
    return used_s / copied * 1e6, size / len(frames)
