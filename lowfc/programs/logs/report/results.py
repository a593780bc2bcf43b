"""All results of a report, as one object for JSON."""

import re
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from lowfc.adapters.logs.parts import missing_between
from lowfc.contract.messages import TRUTH
from lowfc.programs.logs.report import course
from lowfc.programs.logs.report.budget import budget_results
from lowfc.programs.logs.report.closed_loop import (
    groups_of,
    longest_stretch,
    spectra_of,
    spectra_results,
    stretch_results,
)
from lowfc.programs.logs.report.residual import residual_results
from lowfc.programs.logs.report.source import Results, Run
from lowfc.programs.logs.report.timing import timing_results
from lowfc.programs.logs.report.verdict import verdict
from lowfc.programs.logs.survey import recovery_in_words

_NOT_VERSIONS = ("host", "kernel", "processor", "processors", "cpu_features", "blas", "run", "seed", "git")


@dataclass(frozen=True, slots=True)
class Report:
    """A run and its results."""

    run: Run
    results: Results


def report_of(run: Run) -> Report:
    """Compute all results."""
    history = run.history
    stretch = longest_stretch(run)
    spectra = spectra_of(stretch)
    noll = history.calibration.noll if history.calibration is not None else ()
    masks = groups_of(noll) | {"all modes": np.ones(len(noll), bool)}
    residual = residual_results(run, stretch)
    results: Results = {
        "log": _log(run),
        "run": _run(run),
        "mode_steps": course.mode_steps(history),
        "mode_spans": course.mode_spans(run),
        "laws": course.laws(run),
        "closed_stretch": stretch_results(run, stretch),
        "timing": timing_results(run),
        "residual": residual,
        "spectra": spectra_results(run, stretch, spectra),
        "error_budget": budget_results(run, stretch, spectra, masks, shaped=residual["shaped"]),
        "light": course.light_results(history),
        "mirror": course.mirror_results(history),
        "events": course.events(run),
        "requests": course.requests(run),
    }
    return Report(run, {"verdict": verdict(results)} | results)


def _log(run: Run) -> Results:
    log = run.history.log
    missing = missing_between(log.paths)
    recording = log.metadata.get("recording", {})
    lost = {name.removeprefix("lost "): _number(text) for name, text in recording.items() if name.startswith("lost ")}
    return {
        "file": log.path.name,
        "files": [path.name for path in log.paths],
        "selection": log.selection.description,
        "bytes": log.size,
        "finished": log.finished,
        "complete": log.complete and not log.damage and not missing,
        "missing_files": missing,
        "stopped": recording.get("stopped") or None,
        "recovery": recovery_in_words(log.metadata) or None,
        "damage": [{"byte": damage.position, "bytes": damage.length, "why": damage.why} for damage in log.damage],
        "remarks": run.history.remarks,
        "messages": sum(run.history.counts.values()),
        "messages_by_topic": dict(sorted(run.history.counts.items())),
        "messages_lost": _number(recording.get("messages_lost", "")),
        "lost_by_topic": {name: count for name, count in lost.items() if count is not None},
        "messages_unreadable": log.unreadable,
        "steps_left_out": run.history.excluded_messages,
    }


def _number(text: str) -> int | None:
    return int(text) if re.fullmatch("[0-9]{1,20}", text) else None  # the log may have any text


def _run(run: Run) -> Results:
    history = run.history
    recorded = history.log.metadata.get("lowfc", {})
    (first_ns, last_ns), simulated = history.span_ns, TRUTH.key in history.counts
    calibration, configuration, steps = history.calibration, history.configuration, history.steps
    began = datetime.fromtimestamp(first_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return {
        "began": began if first_ns else None,
        "recorded_s": (last_ns - first_ns) * 1e-9,
        "steps": int(steps.sequence.size),
        "steps_s": float(run.step_s[-1]) if steps.sequence.size else 0.0,
        "simulated": simulated,
        "imperfections": configuration.imperfections if configuration is not None and simulated else {},
        "lockstep": configuration.lockstep if configuration is not None else None,
        **{key: recorded.get(key) for key in _NOT_VERSIONS},
        "versions": {name: value for name, value in recorded.items() if name not in _NOT_VERSIONS},
        "calibration": None
        if calibration is None
        else {
            "id": calibration.id,
            "modes": len(calibration.noll),
            "estimator": calibration.estimator,
            "wavelength_nm": calibration.wavelength_nm,
            "measured": not calibration.operator_hash,
            "frame_rows": calibration.shape[0],
            "frame_columns": calibration.shape[1],
            "mirror_rows": calibration.grid[0],
            "mirror_columns": calibration.grid[1],
        },
        "configuration": configuration.model_dump() if configuration is not None else None,
        "realtime_refused": {
            name: list(health.realtime_refused)
            for name, health in sorted(history.health.items())
            if health.realtime_refused
        },
    }
