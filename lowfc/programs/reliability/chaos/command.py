"""The command `lowfc chaos`: inject faults into the real processes and check the loop's response."""

import contextlib
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.logs.series import nearest_existing
from lowfc.adapters.process.terminal import INTERRUPTED, Json
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError, nearest
from lowfc.programs.cli.output import print_result

if TYPE_CHECKING:
    from lowfc.contract.configuration import Configuration
    from lowfc.programs.reliability.chaos.bench import Outcome
    from lowfc.programs.reliability.chaos.case import Case

FAILED_LOGS = Path("chaos-logs")


def chaos(
    case: Annotated[list[str] | None, typer.Option(help="Name of a case; may be repeated.")] = None,
    all_: Annotated[bool, typer.Option("--all", help="Run all cases.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 1,
    keep: Annotated[
        Path | None,
        typer.Option(help=f"Keep the logs of all cases here; default: only of failed cases, in {FAILED_LOGS}."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Inject faults into a simulated loop, case by case, and check its log; exit status 1 if a case failed.

    Without a case, the cases are listed. Each case injects a fault into frames, processes, bus, mirror, disk or
    operator requests. The mirror must stay within its limits, the loop must recover, and the log must have the events
    of the case and account for lost messages. A case that this host cannot run is skipped, with the reason.

    Example: lowfc chaos --case frames-dark --case kill-controller --seed 3
    """
    from lowfc.programs.reliability.chaos.cases import CASES

    unknown = [name for name in case or () if name not in CASES]
    if unknown:
        raise ConfigurationError(
            f"there is no case {unknown[0]!r}{nearest(unknown[0], CASES)}; `lowfc chaos` lists them"
        )
    names = list(CASES) if all_ else case or []
    if not names:
        width = max(map(len, CASES))
        table = "\n".join(f"{each.name:{width}}  {each.description}" for each in CASES.values())
        listed = [{"name": each.name, "sentence": each.description} for each in CASES.values()]
        print_result({"cases": listed}, table, as_json=as_json)
        return
    _require_writable(keep or FAILED_LOGS)
    rows: list[dict[str, Any]] = []
    interrupted = False
    try:
        for number, name in enumerate(names, 1):
            sys.stderr.write(f"{number} of {len(names)}: {name}: {CASES[name].description}\n")
            rows.append(run_case(CASES[name], seed, keep))
            sys.stderr.write(f"    {_result(rows[-1])} in {rows[-1]['seconds']:.0f} s\n")
    except KeyboardInterrupt:
        interrupted = True  # the results so far are printed
    results = {"seed": seed, "asked": len(names), **counts(rows), "cases": rows}
    print_result(results, render(results), as_json=as_json)
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    if results["failed"]:
        raise typer.Exit(1)


def _require_writable(folder: Path) -> None:
    """Check before the first case that logs can be kept in a folder, which may not exist yet."""
    nearest_folder = nearest_existing(folder)
    if not nearest_folder.is_dir() or not os.access(nearest_folder, os.W_OK):
        raise DataFileError(
            f"no logs can be kept in {folder}: {nearest_folder} is not a writable folder; name another with --keep"
        )


def run_case(case: "Case", seed: int, keep: Path | None) -> dict[str, Any]:
    """Run one case in its own folder, and judge it; without `keep`, only the log of a failed case is kept."""
    row: dict[str, Any] = {"name": case.name, "sentence": case.description, "seconds": 0.0}
    row |= {"passed": False, "skipped": case.why_skipped() or None, "log": None, "findings": {}, "figures": {}}
    if row["skipped"]:
        return row | {"detail": row["skipped"]}
    begun_s, folder = time.monotonic(), Path(tempfile.mkdtemp(prefix=f"lowfc-chaos-{case.name}-"))
    try:
        row |= _judged(_run(case, folder, random.Random(f"{seed} {case.name}")), case)  # noqa: S311  # nothing secret
    except Exception as error:  # an error in the case itself fails only this case
        row["findings"] = {"error": {"held": False, "found": _in_one_line(error, folder)}}
    finally:
        if keep is not None or (row["findings"] and not row["passed"]):
            row["log"] = str(folder)
            with contextlib.suppress(OSError):  # if the disk has become full, the log stays where it is
                kept = (keep or FAILED_LOGS) / f"{case.name}-{seed}"
                kept.parent.mkdir(parents=True, exist_ok=True)
                shutil.rmtree(kept, ignore_errors=True)
                row["log"] = str(shutil.move(folder, kept))
        else:
            shutil.rmtree(folder, ignore_errors=True)
    return row | {"seconds": time.monotonic() - begun_s, "detail": "; ".join(_wrong(row)) or _recovery(row)}


def _wrong(row: dict[str, Any]) -> list[str]:
    """The rules that did not hold, and what was found."""
    return [f"{rule}: {finding['found']}" for rule, finding in row["findings"].items() if not finding["held"]]


def _recovery(row: dict[str, Any]) -> str:
    """What the rule on recovery found; empty if this rule was not checked."""
    return str(row["findings"].get("recovery", {}).get("found", ""))


def _judged(outcome: "Outcome", case: "Case") -> dict[str, Any]:
    """Verdict, findings and measurements of a case that has run."""
    from lowfc.programs.reliability.chaos.evidence import read
    from lowfc.programs.reliability.chaos.rules import judge, recovered_s, restart_steps_nm

    evidence = read(outcome.folder)
    findings, measurements = judge(case, outcome, evidence), dict(outcome.measurements)
    if steps_nm := restart_steps_nm(evidence):
        measurements["restart_step_nm"] = round(max(steps_nm), 3)
    if (seconds := recovered_s(outcome, evidence)) is not None:
        measurements["recovered_s"] = round(seconds, 3)
    return {
        "passed": all(finding.held for finding in findings),
        "findings": {finding.rule: {"held": finding.held, "found": finding.found} for finding in findings},
        "figures": measurements,
    }


def _in_one_line(error: Exception, folder: Path) -> str:
    """An error in one line; its traceback is written to the case's folder."""
    with contextlib.suppress(OSError), (folder / "error.txt").open("a") as file:  # the disk may be full
        traceback.print_exception(error, file=file)
    return str(error) if isinstance(error, LowfcError) else f"{type(error).__name__}: {error}"


def _run(case: "Case", folder: Path, rng: random.Random) -> "Outcome":
    """Run a case; errors are added to the outcome's notes, and the processes are always stopped."""
    from lowfc.programs.reliability.chaos.bench import ChaosBench
    from lowfc.programs.reliability.chaos.frames import FAULTY_FRAMES, FIRST

    fault = {"kind": case.fault, "first": FIRST, "frames": FAULTY_FRAMES, "seed": rng.getrandbits(32)}
    bench = ChaosBench(configured(case, folder), folder, rng, fault if case.fault else None)
    try:
        bench.begin()
        case.run(bench)
    except Exception as error:
        bench.outcome.notes.append(_in_one_line(error, folder))
    finally:
        bench.end()
    return bench.outcome


def configured(case: "Case", folder: Path) -> "Configuration":
    """The configuration of a case: the loop starts closed, its logs are in `folder`, and the case's values are set."""
    from lowfc.adapters.process.realtime import spread
    from lowfc.contract.configuration import FIXED_GAINS, load

    defaults = {
        "control.start_mode": "closed",
        **FIXED_GAINS,
        "recorder.folder": str(folder),
        "recorder.min_free_mb": 50.0,
        **spread(os.sched_getaffinity(0)),
    }
    return load(None, {**defaults, **case.config})


def counts(rows: list[dict[str, Any]]) -> dict[str, int]:
    """Numbers of cases passed, failed and skipped."""
    passed, skipped = (sum(bool(row[key]) for row in rows) for key in ("passed", "skipped"))
    return {"passed": passed, "failed": len(rows) - passed - skipped, "skipped": skipped}


def _result(row: dict[str, Any]) -> str:
    return f"skipped: {row['skipped']}" if row["skipped"] else "passed" if row["passed"] else "FAILED"


def render(results: dict[str, Any]) -> str:
    """The results as text: a line for each case, and below it failed rules, measurements and the folder of the logs."""
    lines = []
    width = max((len(row["name"]) for row in results["cases"]), default=0)
    for row in results["cases"]:
        lines.append(f"{row['name']:{width}}  {_result(row):6}  {row['seconds']:5.1f} s  {_recovery(row)}")
        lines += [f"    {wrong}" for wrong in _wrong(row)]
        lines += [f"    {name}: {value}" for name, value in row["figures"].items()]
        if row["log"] is not None:
            lines.append(f"    logs: {row['log']}")
    totals = [f"{results['passed']} passed", f"{results['failed']} failed"]
    if results["skipped"]:
        totals.append(f"{results['skipped']} skipped")
    if not_run := results["asked"] - len(results["cases"]):
        totals.append(f"{not_run} not run")
    lines.append(f"{', '.join(totals)}, seed {results['seed']}")
    return "\n".join(lines)
