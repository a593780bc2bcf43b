"""Measurements of `lowfc sim-loop`: residual, latency and logs."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from lowfc.contract.configuration import load
from tools.laws import tilt_residual_mas
from tools.shared import Results, formatted_table, json_of

LOOP = "lowfc sim-loop --disturbance reaction-wheel --star-magnitude 2 --sensor sam27d10_bal14 --duration 20"
KEYS = {"disturbance.preset": "reaction-wheel", "star.magnitude": 2.0, "sensor.sam": "sam27d10_bal14"}
"""Configuration keys with the same effect as the options of `LOOP`."""
NORMAL = "[realtime]\npriority = 0\nlock_memory = false\ndisable_cpu_idle = false\n"
RUNS = (
    ("250 Hz, SCHED_FIFO", 250, "", ""),
    ("250 Hz, normal scheduling", 250, "", NORMAL),
    ("500 Hz, SCHED_FIFO", 500, "", ""),
    ("1000 Hz, SCHED_FIFO", 1000, "", ""),
    ("1000 Hz, normal scheduling", 1000, "", NORMAL),
    ("1000 Hz of simulated time, in lockstep", 1000, " --lockstep", ""),
)
RECORDED_S = (60, 600)
RECORDED = "lowfc sim-loop --rate 1000 --disturbance reaction-wheel --duration"
LOG_COMMANDS = (*(f"{RECORDED} {seconds}" for seconds in RECORDED_S), "lowfc replay", "lowfc bench record")


def measure() -> Results:
    """Run the loop once for each of `RUNS`."""
    runs = {}
    for name, rate_hz, option, toml in RUNS:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "run.toml"
            file.write_text(toml)
            run = json_of(f"{LOOP} --rate {rate_hz}{option} --config run.toml", folder) | {"log": None, "logs": []}
            # Mean delay: one frame if the command was in time, two if it was late.
            delay = 1 + run["commands_late"] / run["frames_published"]
            config = load(file, KEYS | {"camera.rate_hz": float(rate_hz), "camera.delay_frames": delay})
            runs[name] = run | {"tilt_predicted_mas": round(tilt_residual_mas(config), 4)}
    return {"runs": runs}


LOOP_COLUMNS = {
    "loop": "{name}",
    "rate": "{rate_hz:.1f} Hz",
    "tilt disturbance, mas rms per axis": "{tilt_disturbance_mas:.1f}",
    "tilt residual, mas rms per axis": "{tilt_residual_mas:.2f}",
    "predicted residual, mas rms per axis": "{tilt_predicted_mas:.2f}",
    **{
        f"{title}, us: p50 / p99 / p99.9": " / ".join(
            f"{{latency_us[{stage}][{p}]:.0f}}" for p in ("p50", "p99", "p99_9")
        )
        for title, stage in (("frame to command", "frame_to_command"), ("frame to mirror", "frame_to_mirror"))
    },
    "frames skipped or missing": "{dropped} of {frames_published}",
    "messages lost": "{messages_lost} of {messages}",
}


SHORT_COLUMNS = {
    "simulated loop, reaction-wheel jitter": "{name}",
    "frame to command, p50 / p99, us": "{latency_us[frame_to_command][p50]:.0f} / "
    "{latency_us[frame_to_command][p99]:.0f}",
    "tilt disturbance, mas rms per axis": "{tilt_disturbance_mas:.1f}",
    "tilt residual, mas rms per axis": "{tilt_residual_mas:.1f}",
}


SHORT_NOTE = f"""\
Mask `{KEYS["sensor.sam"]}` (not the default), star of V = {KEYS["star.magnitude"]:g}. Latency is from sending the frame
to sending the command; read-out is not included. The jitter is drawn frame by frame, so its realisation differs
between rates. [Performance](docs/measured/performance.md) has all runs and the method."""


def short(results: Results) -> str:
    """Rate, latency and residual of the runs with real-time scheduling."""
    runs = results["runs"].items()
    rows = (run | {"name": name.partition(",")[0]} for name, run in runs if "SCHED_FIFO" in name)
    return f"{formatted_table(SHORT_COLUMNS, rows)}\n{SHORT_NOTE}\n"


def render(results: Results) -> str:
    """A row for each run."""
    rows = (
        run
        | {"name": name, "dropped": run["frames_skipped"] + run["frames_missing"]}
        | {"messages": run["messages_lost"] + run["messages_recorded"]}
        for name, run in results["runs"].items()
    )
    return (
        f"{formatted_table(LOOP_COLUMNS, rows)}\n"
        "The rate is by the host's clock. Frame to command "
        "ends when the controller's send returns; the mirror may have received the command before. The "
        "predicted residual is for the disturbance's expected spectrum and the measured delay, without lost frames; "
        "each run has one realisation of the disturbance."
    )


def measure_logs() -> Results:
    """Record at several rates; record one and ten minutes, and replay them in one process and on all processors.

    It takes 15 minutes and 10 GB.
    """
    logs: Results = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = json_of("lowfc bench record", folder)
        for seconds in RECORDED_S:
            run = json_of(f"{RECORDED} {seconds}", folder)
            files = " ".join(run["logs"])
            alone, peak_bytes = _json_and_peak_bytes(folder, f"replay --jobs 1 --json {files}")
            paths = [Path(folder) / log for log in run["logs"]]
            logs[str(seconds)] = {
                "log_bytes": sum(log.stat().st_size for log in paths),
                **{key: run[key] for key in ("messages_recorded", "messages_lost", "frames_processed")},
                **{key: alone[key] for key in ("frames", "commands", "states", "unchecked", "identical")},
                "largest_difference_nm": alone["largest_difference_nm"],
                "replay_bytes": peak_bytes,
                "speed_one": alone["speed"],
                "speed_all": json_of(f"lowfc replay {files}", folder)["speed"],
            }
            for log in paths:
                log.unlink()
    return {"recording": recording, "logs": logs}


def _json_and_peak_bytes(folder: str, arguments: str) -> tuple[Results, int]:
    """JSON printed by a command with --json, and its peak memory, bytes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "lowfc", *arguments.split()], cwd=folder, stdout=subprocess.PIPE, text=True
    )
    printed = process.stdout.read() if process.stdout else ""
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"`lowfc {arguments}` failed")
    return json.loads(printed), used.ru_maxrss * 1024


LOG_COLUMNS = {
    "duration of the log at 1 kHz": "{seconds} s",
    "size": "{log_mb:.0f} MB",
    "messages": "{messages_recorded}",
    "lost": "{messages_lost}",
    "steps replayed": "{frames} of {frames_processed}",
    "steps unchecked": "{unchecked}",
    "largest difference": "{largest_difference_nm:g} nm",
    "replay speed, one process": "{speed_one:.1f} x",
    "replay speed, all processors": "{speed_all:.1f} x",
    "memory of replay, one process": "{replay_mb:.0f} MB",
}
RECORDER_COLUMNS = {
    "frame rate": "{offered_hz:.0f} Hz",
    "processor time": "{cpu_percent:.0f} %",
    "processor time / time to copy the payloads": "{ratio:.0f} x",
    "messages": "{messages_published}",
    "lost": "{messages_lost}",
    "longest time to write a message": "{longest_wait_ms:.0f} ms",
    "longest time to flush a message": "{longest_unflushed_ms:.0f} ms",
    "longest write call": "{longest_write_ms:.1f} ms",
}


def render_logs(results: Results) -> str:
    """A table with a row for each log, and a table with a row for each frame rate at the recorder."""
    logs = (
        log | {"seconds": seconds, "log_mb": log["log_bytes"] / 1e6, "replay_mb": log["replay_bytes"] / 1e6}
        for seconds, log in results["logs"].items()
    )
    rates = (rate | {"cpu_percent": 100 * rate["cpu_share"]} for rate in results["recording"]["rates"])
    return (
        f"{formatted_table(LOG_COLUMNS, logs)}\n{formatted_table(RECORDER_COLUMNS, rates)}\n"
        "Replay speed is relative to real time. The recorder's processor time is that of all its threads, as a "
        "fraction of one processor. The times to write and to flush a message begin with its arrival; they end when it "
        "is written, and when it would survive a kill -9 of the recorder."
    )
