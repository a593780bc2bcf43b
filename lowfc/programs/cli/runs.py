"""`lowfc runs`: the runs on this host, with their loop mode, processes and log."""

from typing import Any

from lowfc.adapters.bus.other_loops import no_loop_message
from lowfc.adapters.bus.run import open_run, runtime_path
from lowfc.adapters.process.terminal import Json
from lowfc.client import Client
from lowfc.client.runs import live_runs
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import Role
from lowfc.control.loop.wording import hertz, mode_word
from lowfc.programs.cli.output import print_result
from lowfc.programs.cli.status import NO_HEALTH, recording_state
from lowfc.programs.launch.watch import mode_name


def runs(as_json: Json = False) -> None:
    """List the runs on this host: loop mode, processes, log.

    Example: lowfc runs
    """
    rows, not_joined = [], {}
    for name, roles in live_runs().items():
        try:
            rows.append(_row(name, roles))
        except LowfcError as fault:  # the run has just ended, or this host has no operator's certificate
            not_joined[name] = str(fault)
    results = {"runs": rows, "not_joined": not_joined, "searched": str(runtime_path())}
    lines = [*_lines(rows), *(f"{name}  cannot be joined: {why}" for name, why in not_joined.items())]
    print_result(results, "\n".join(lines) or no_loop_message(), as_json=as_json)


def _row(name: str, roles: set[str]) -> dict[str, Any]:
    """State of a run from the Health of its processes; a process that has not sent one yet is starting."""
    with Client(name) as loop:
        alive = loop.processes()
    roles = set(alive) if open_run(name, ()).links.network.router else roles  # with a router, only the router listens
    controller, recorder = alive.get(Role.CONTROLLER, NO_HEALTH), alive.get(Role.RECORDER, NO_HEALTH)
    starting = [{"process": role, "state": "starting", "pid": None} for role in roles - {*alive, Role.LAUNCHER}]
    processes = [{"process": key, "state": health.state, "pid": health.pid} for key, health in alive.items()]
    return {
        "run": name,
        "mode": mode_name(controller.mode) or ("starting" if {Role.LAUNCHER, Role.CONTROLLER} & roles else None),
        "holding": controller.holding or None,
        "rate_hz": controller.rate_hz if controller.mode else None,
        "uptime_s": controller.uptime_ns * 1e-9 if controller.mode else None,
        "processes": sorted(processes + starting, key=lambda one: str(one["process"])),
        "recording": recording_state(recorder),
        "log": recorder.recording.file or None,
    }


def _lines(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    for row in rows:
        mode = "no controller" if row["mode"] is None else mode_word(row["mode"])
        if row["mode"] == "starting":  # the controller has not reported yet
            mode += " or not answering"
        if row["holding"]:
            mode += f" (not correcting: {row['holding']})"
        rate = "" if row["rate_hz"] is None else f" at {hertz(row['rate_hz'])}, up {row['uptime_s']:.0f} s"
        starting = {one["process"] for one in row["processes"] if one["state"] == "starting"}
        no_recorder = "its recorder is starting or not answering" if Role.RECORDER in starting else "not recording"
        recordings = {"recording": f"recording {row['log']}", "none": no_recorder}
        processes = ", ".join(one["process"] for one in row["processes"]) or "no process yet"
        recording = recordings.get(row["recording"], f"recording {row['recording']}")
        lines.append(f"{row['run']}  {mode}{rate}; {processes}; {recording}")
    return lines
