"""The command `lowfc design sam`: executors, interruption and resumption, files, and its errors."""

import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from itertools import pairwise

import numpy as np
import psutil
import pytest
from rich.console import Console

from lowfc.adapters.files.layouts import SHIPPED, load_layout
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError
from lowfc.design.goal import merit
from lowfc.design.sam_merit import SamCandidate, hole_fields
from lowfc.design.sam_search import BLOCK
from lowfc.programs.design import sam as program
from lowfc.programs.design import sam_executors as executors
from lowfc.programs.design.sam_executors import InProcessExecutor, open_executor
from lowfc.programs.design.sam_files import read_state
from lowfc.programs.design.sam_request import Search
from tests.support.loops import json_of, lowfc, refusal, until

RECORDED_COMMANDS = {
    name: entry["command"] for name, entry in json.loads(SHIPPED.read_text())["layouts"].items() if "command" in entry
}
SMALL = {"merit": "table4", "holes": "4", "diameter": "0.1:0.2", "steps": BLOCK + 10, "chains": 2, "seed": 7}


class Interrupted(InProcessExecutor):
    """Executor that raises KeyboardInterrupt, as at Ctrl-C, after a number of blocks."""

    def __init__(self, blocks: int) -> None:
        self.blocks = blocks

    def submit(self, fn, /, *args, **kwargs):
        if not self.blocks:
            raise KeyboardInterrupt
        self.blocks -= 1
        return super().submit(fn, *args, **kwargs)


def search_with(**options) -> Search:
    return Search(**{"name": "small", **SMALL, **options})


def run(search, folder, executor, chains=None, console=None, **files):
    """Run or resume a search; return its result and the path of its layout file."""
    out = folder / "mask.json"
    chains = program.begin(search) if chains is None else chains
    console = Console(quiet=True) if console is None else console
    return program.design_sam(search, chains, out, folder / "state.json", executor, **files, console=console), out


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Result and layout file of an uninterrupted search in this process."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    result, out = run(search_with(), folder, InProcessExecutor())
    assert [path.name for path in folder.iterdir()] == ["mask.json"]
    return result, out.read_text()


def test_result_does_not_depend_on_the_executor(uninterrupted, tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        for jobs, address in ((2, None), (1, cluster.scheduler_address)):
            with open_executor(jobs, address) as executor:
                result, out = run(search_with(), tmp_path, executor)
            assert out.read_text() == uninterrupted[1], address
            assert result["merits"] == uninterrupted[0]["merits"]
    assert len(set(result["merits"])) == 2


@pytest.mark.parametrize("blocks", [1, 3])
def test_interrupted_search_writes_its_best_layout_and_resumes(blocks, uninterrupted, tmp_path):
    result, out = run(search_with(), tmp_path, Interrupted(blocks))
    assert result["interrupted"]
    assert result["steps"] < 2 * SMALL["steps"]
    load_layout(str(out))  # the best layout so far is valid
    text = program.render(result)
    assert f"--resume {result['resume']}" in text
    assert " nm (monochromatic), which adds " in text
    assert "reproduced" not in text
    search, chains = read_state(tmp_path / "state.json", program.pupil_digest())
    assert search == search_with()
    again, out = run(search, tmp_path, InProcessExecutor(), chains)
    assert (again["merits"], out.read_text()) == (uninterrupted[0]["merits"], uninterrupted[1])
    assert not again["interrupted"]
    assert not (tmp_path / "state.json").exists()


def test_interrupt_before_the_first_block_reports_that_nothing_was_found(tmp_path):
    output = io.StringIO()
    with pytest.raises(KeyboardInterrupt):
        run(search_with(), tmp_path, Interrupted(0), console=Console(file=output, width=200))
    assert "nothing was found, nothing is written" in output.getvalue()
    assert list(tmp_path.iterdir()) == []


class Broken(Interrupted):
    """Executor whose workers die after a number of blocks."""

    def submit(self, fn, /, *args, **kwargs):
        if self.blocks:
            return super().submit(fn, *args, **kwargs)
        future = Future()
        future.set_exception(BrokenProcessPool("a process was terminated abruptly"))
        return future


def test_lost_workers_are_reported_and_the_search_resumes(uninterrupted, tmp_path):
    lost = r"workers were lost .*abruptly.*\); "
    with pytest.raises(LowfcError, match=f"{lost}no chain had finished .* nothing is written"):
        run(search_with(), tmp_path, Broken(0))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(LowfcError, match=rf"{lost}continue with --resume .*state\.json --out .*mask\.json"):
        run(search_with(), tmp_path, Broken(2))
    search, chains = read_state(tmp_path / "state.json", program.pupil_digest())
    _, out = run(search, tmp_path, InProcessExecutor(), chains)
    assert out.read_text() == uninterrupted[1]


KILLED = """
import os, signal
from lowfc.programs.design.sam_executors import open_executor
with open_executor(2, None) as pool:
    print(pool.submit(os.getpid).result(), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_worker_ends_when_its_search_is_killed(tmp_path):
    with (tmp_path / "worker").open("w") as output:
        assert subprocess.run([sys.executable, "-c", KILLED], stdout=output, check=False).returncode == -signal.SIGKILL
    worker = int((tmp_path / "worker").read_text())
    until(lambda: not is_running(worker))


def is_running(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_workers_ignore_ctrl_c_and_their_death_is_distinguished_from_an_error_in_the_search(tmp_path, monkeypatch):
    with open_executor(2, None) as executor:
        assert signal.SIGINT in executor.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result()
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
        future = executor.submit(os._exit, 1)
        assert executors.is_lost(future.exception())
    monkeypatch.setattr(program, "advance", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(search_with(), tmp_path, InProcessExecutor())


def test_worker_with_another_pupil_is_refused():
    search = search_with()
    with pytest.raises(ConfigurationError, match="another shaped pupil: install the same lowfc"):
        program.advance_block(search, program.begin(search)[0], "another")


def test_the_command_does_not_overwrite_an_interrupted_search(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state = tmp_path / "mask.json.state.json"
    program.write_state(state, search_with(), program.pupil_digest(), program.begin(search_with()))
    before = state.read_bytes()
    assert f"continue with --resume {state.name} --out mask.json, or delete it" in refusal(
        "design", "sam", "--out", "mask.json", kind=ConfigurationError
    )
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == {state: before}
    assert isinstance(lowfc("design", "sam", "--resume", state.name, "--out", state.name).exception, ConfigurationError)
    assert state.read_bytes() == before
    ran = lowfc("design", "sam", "--resume", state.name, "--out", "mask.json", "--jobs", 1)
    assert ran.exit_code == 0, ran.output
    assert [path.name for path in tmp_path.iterdir()] == ["mask.json"]


def test_state_files_are_read_or_refused(tmp_path):
    search = search_with()
    state = tmp_path / "state.json"
    with pytest.raises(DataFileError, match="no search to resume"):
        read_state(state, "pupil")
    state.write_text('{"search": {}}')
    with pytest.raises(DataFileError, match="not the state of a search"):
        read_state(state, "pupil")
    program.write_state(state, search, "pupil", [])
    with pytest.raises(DataFileError, match="0 chains, expected 2"):
        read_state(state, "pupil")
    program.write_state(state, search, "pupil", program.begin(search))
    assert read_state(state, "pupil") == (search, program.begin(search))
    with pytest.raises(DataFileError, match="another shaped pupil"):
        read_state(state, "another")


@pytest.mark.usefixtures("without_layout")
def test_pareto_front_is_written_and_plotted(tmp_path):
    search = search_with(merit="pareto", chains=3, steps=60, name="edge", estimator="pinv", seed=4)
    table, picture = tmp_path / "front.csv", tmp_path / "front.png"
    result, out = run(search, tmp_path, InProcessExecutor(), front_file=table, plot_file=picture)
    head, *rows = [line.split(",") for line in table.read_text().splitlines()]
    assert head[:4] == ["layout", "holes", "table3_waves", "table4_mas"]
    assert [row[1] for row in rows] == ["4"] * 3
    on_front = [(float(row[2]), float(row[3])) for row in rows if row[-1] == "1"]
    assert all(b[0] > a[0] and b[1] < a[1] for a, b in pairwise(on_front))
    assert len(on_front) == 2, "with this seed one layout is worse than another in both tables"
    assert {layout["name"] for layout in result["layouts"]} == {row[0] for row in rows if row[-1] == "1"}
    assert picture.read_bytes().startswith(b"\x89PNG")
    for layout in result["layouts"]:
        assert len(load_layout(f"{out}:{layout['name']}").holes) == 4


def test_command_is_recorded_and_reproduces_the_layout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    search = ["--merit", "condition", "--holes", 5, "--steps", 30, "--symmetry", "x", "--jobs", 1]
    result = json_of("design", "sam", *search)
    assert list(result["layouts"][0]["focal_masks"]) == ["disk", "bowtie"]
    first = json.loads((tmp_path / "sam.json").read_text())["layouts"]["sam"]
    assert (first["merit"], first["seed"], first["command"]) == ("condition", 1, result["command"])
    arguments = shlex.split(first["command"])
    assert arguments[:3] == ["lowfc", "design", "sam"]
    again = lowfc(*arguments[1:], "--jobs", 1, "--out", "again.json")
    assert again.exit_code == 0, again.output
    assert json.loads((tmp_path / "again.json").read_text())["layouts"]["sam"] == first
    assert result["command"] in program.render(result)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--merit", "beauty"), "merit must be one of paper, table3"),
        (("--estimator", "best"), "estimator must be one of"),
        (("--modes", "15"), "modes must be 14 or 20"),
        (("--merit", "table3", "--weight", "0.5"), "belongs to the merits paper and pareto"),
        (("--merit", "pareto", "--weight", "2"), "a weight, 0 to 1"),
        (("--merit", "pareto", "--chains", "1"), "at least 2 chains"),
        (("--merit", "table3", "--focal-mask", "both"), "only 'paper' uses both"),
        (("--focal-mask", "square"), "--focal-mask must be"),
        (("--holes", "many"), "--holes must be a number"),
        (("--holes", "9:4"), "number of holes"),
        (("--holes", "8:"), "--holes must be a number"),
        (("--holes", "2.5"), "--holes must be in steps of 1,"),
        (("--diameter", "0.0705"), "--diameter must be in steps of 0.001"),
        (("--diameter", "2"), "hole diameters"),
        (("--diameter", "0.007", "--holes", "1"), "between 0.008 and 1"),
        (("--diameter", "nan"), "--diameter must be a number"),
        (("--gap", "-0.1"), "gap and edge must not be negative"),
        (("--symmetry", "z"), "symmetry must be one of"),
        (("--seed", "-1"), "seed must not be negative"),
        (("--chains", "0"), "chains must be at least 1"),
        (("--steps", "0"), "steps must be at least 1"),
        (("--name", "a b"), "--name must consist of"),
        (("--holes", "40", "--diameter", "0.2"), "40 holes .* could not be placed"),
        (("--holes", "1", "--diameter", "1"), "1 hole of .* could not be placed"),
        (("--scheduler", "nowhere:1"), "no Dask scheduler answers at 'nowhere:1'"),
        (("--jobs", "2", "--scheduler", "nowhere:1"), "--jobs and --scheduler exclude each other"),
        (("--resume", "nowhere.json"), "no search to resume in nowhere.json"),
        (("--resume", "nowhere.json", "--focal-mask", "disk"), "omit --focal-mask"),
        (("--out", "nowhere/mask.json"), "nowhere/mask.json cannot be written: there is no directory nowhere"),
        (("--front", "nowhere/front.csv"), "nowhere/front.csv cannot be written: there is no directory nowhere"),
        (("--plot", "nowhere/front.png"), "nowhere/front.png cannot be written: there is no directory nowhere"),
        (("--out", "mask.txt"), "--out must end in .json, .* got mask.txt"),
        (("--out", "mask.json", "--front", "./mask.json"), "must be different files"),
    ],
)
def test_invalid_options_give_one_line_errors(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(executors, "DASK_TIMEOUT_S", 0.2)
    error = refusal("design", "sam", *options, kind=(ConfigurationError, DataFileError))
    assert re.search(message, error)
    assert "\n" not in error
    assert list(tmp_path.iterdir()) == []


def test_missing_packages_are_reported_before_the_search(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigurationError, match=r"pip install .*'distributed"), open_executor(1, "x:1"):
        pass
    with pytest.raises(ConfigurationError, match=r"pip install .*'matplotlib"):
        run(search_with(), tmp_path, Interrupted(0), plot_file=tmp_path / "front.png")


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", RECORDED_COMMANDS)
def test_recorded_command_finds_a_layout_as_good_as_the_packaged_one(tmp_path, name):
    """The merits agree within 3 %: the merit of one chain scatters by 2 % with the seed.

    The layouts differ: the search that found the packaged ones overestimated the light through small holes, and the
    processor's rounding decides between steps of nearly equal merit.
    """
    ran = lowfc(*shlex.split(RECORDED_COMMANDS[name])[1:], "--jobs", 1, "--out", tmp_path / "mask.json")
    assert ran.exit_code == 0, ran.output
    focal_mask = RECORDED_COMMANDS[name].partition("--focal-mask ")[2].split()[0]
    search = Search(merit="paper", weight=0.35, focal_mask=focal_mask)
    optics = program._optics(search.focal_masks)

    def merit_of(layout: str) -> float:
        fields = [hole_fields(optics, hole) for hole in load_layout(layout).holes]
        return merit(SamCandidate(optics, np.sum(fields, axis=0)), search.goal)

    assert merit_of(f"{tmp_path / 'mask.json'}:{name}") == pytest.approx(merit_of(name), rel=0.03)
