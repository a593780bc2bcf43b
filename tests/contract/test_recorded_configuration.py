"""The configuration in a log of another version: unusable parts cause remarks, and the log is still read."""

import json
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.adapters.logs.history import attached_configuration, read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.contract.configuration import MAX_FAULTS, Configuration, load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.recorded_configuration import recorded
from lowfc.programs.commissioning.acceptance.probe import ANNOUNCEMENT
from lowfc.programs.view.recorded import draw_logs
from lowfc.programs.view.renderer import Renderer
from tests.support.loops import lowfc
from tests.support.report_log import SyntheticLog
from tests.support.stage import Tape

OTHER_VERSION = "[camera]\nrate_hz = 300.0\nshutter = 'rolling'\n[control]\nleak = 7.0\n[weather]\nwind = 3\n"
"""Two unknown keys and an invalid value."""
REMARKS = [
    "unknown key 'camera.shutter'; the nearest known one is 'camera.noise'; it is ignored",
    "control.leak = 7.0: must be less than or equal to 1; the default is used",
    "unknown key 'weather'; it is ignored",
]


def test_known_keys_are_used_and_unknown_or_invalid_ones_cause_remarks() -> None:
    config, remarks = recorded(OTHER_VERSION.encode())
    assert config == load(None, {"camera.rate_hz": 300.0})
    assert remarks == REMARKS
    assert recorded(Configuration().to_toml().encode()) == (Configuration(), [])
    interlock_of_later_version = (
        b"[[interlocks]]\nname = 'flow'\nvalue = 'on'\ntest = 'above'\naction = 'explode'\nfoo = 1\n"
    )
    interlock_with_unknown_keys = b"[[interlocks]]\nname = 'dome'\nvalue = 1.0\naction = 'open'\nfoo = 1\nbar = 2\n"
    config, _ = recorded(interlock_of_later_version + interlock_with_unknown_keys + b"[[more]]\n")
    assert [interlock.name for interlock in config.interlocks] == ["dome"]


@pytest.mark.parametrize(
    ("toml", "changed", "remark"),
    [
        ("camera = 5", {}, "camera = 5: must be a valid dictionary"),
        ("seed = -1", {}, "seed = -1: "),
        ("[mirror]\ndead = [1, 'x']\nrows = 33", {"mirror.rows": 33}, "mirror.dead.1 = 'x': "),
        ("[disturbance]\npreset = 'quake'\nscale = 2.0", {"disturbance.scale": 2.0}, "disturbance.preset = 'quake'"),
        ("[[control]]\ngain = 0.1", {}, "control = [{'gain': 0.1}]"),
        ("[interlocks]\nname = 'flow'", {}, "interlocks = {'name': 'flow'}: must be a valid list"),
        ("[seed]\nof = 'noise'", {}, "seed = {'of': 'noise'}: must be a valid integer"),
    ],
)
def test_an_invalid_value_is_replaced_by_the_default(toml: str, changed: dict[str, object], remark: str) -> None:
    config, remarks = recorded(toml.encode())
    assert config == load(None, changed)
    (only_remark,) = remarks
    assert only_remark.startswith(remark)
    assert only_remark.endswith("; the default is used")


def test_contradicting_values_stay_as_recorded() -> None:
    toml = "[safety]\nstroke_nm = 900.0\n[mirror]\nrows = 33\n[disturbance.static_nm]\nfocus = 3.0\n[camera]\nfoo = 1\n"
    config, remarks = recorded(toml.encode())
    assert (config.safety.stroke_nm, config.mirror.rows, config.disturbance.static_nm) == (900.0, 33, {"focus": 3.0})
    assert (config.mirror.columns, config.disturbance.preset, config.camera) == (34, "bench", Configuration().camera)
    assert len(remarks) == 2
    assert remarks[1].endswith("; used as recorded")
    config, remarks = recorded(b"[safety]\nstroke_nm = 900.0\n")
    assert config.safety.stroke_nm == 900.0
    assert remarks == [
        "safety.stroke_nm is 900 nm either way, but mirror.stroke_nm gives only 750 nm either way; used as recorded"
    ]
    assert "stroke_nm = 900.0" in config.to_toml()


def test_the_number_of_remarks_is_limited() -> None:
    _, remarks = recorded("".join(f"k{number} = 1\n" for number in range(2000)).encode())
    assert len(remarks) == MAX_FAULTS + 1
    assert remarks[-1] == f"and {2000 - MAX_FAULTS} more"


@pytest.mark.parametrize("toml", ["[camera", "a = " + "[" * 100_000, "#" * (1 << 20) + "#"])
def test_an_unreadable_configuration_causes_a_remark_on_its_log(tmp_path: Path, toml: str) -> None:
    with pytest.raises(ConfigurationError, match="not a readable TOML file"):
        recorded(toml.encode())
    night = SyntheticLog().frames(5)
    log = night.write(tmp_path / "night.mcap", toml=toml)
    history = read_history(LogReader(log))
    assert history.configuration is None
    (remark,) = history.remarks
    assert remark.startswith(f"{log}: its config.toml cannot be used: not a readable TOML file")


@pytest.fixture(scope="module")
def night() -> SyntheticLog:
    """A loop that was open, then closed, with an acceptance test of its noise."""
    recording = SyntheticLog()
    for loop, frames in (("open", 500), ("closed", 1200)):
        recording.request({"open": "open", "closed": "close"}[loop])
        recording.frames(200)
        recording.request("note", text=ANNOUNCEMENT + json.dumps({"test": "noise-floor", "loop": loop, "frames": 400}))
        recording.frames(frames)
    return recording


@pytest.fixture(scope="module")
def written(night: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], bytes]:
    """Function that returns the content of the log for a configuration in TOML."""
    return cache(lambda toml: night.write(tmp_path_factory.mktemp("night") / "night.mcap", toml=toml).read_bytes())


@pytest.fixture
def log_with(tmp_path: Path, written: Callable[[str], bytes]) -> Callable[[str], Path]:
    def write_log(toml: str) -> Path:
        (path := tmp_path / "night.mcap").write_bytes(written(toml))
        return path

    return write_log


@pytest.fixture
def log(log_with: Callable[[str], Path]) -> Path:
    return log_with(OTHER_VERSION)


@pytest.mark.usefixtures("without_drawings")
@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "--json"),
        ("report",),
        ("export", "--to", "npz", "--json"),
        ("tune",),
        ("what-if", "--set", "gain=0.3", "--json"),
        ("acceptance", "noise-floor"),
    ],
    ids=" ".join,
)
def test_every_reader_reads_the_log_and_reports_the_remarks(log: Path, arguments: tuple[str, ...]) -> None:
    done = lowfc(*arguments, log)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == (1 if "acceptance" in arguments and "FAILED" in done.output else 0), done.output
    output = "".join(done.output.split())
    for remark in remarks_on(log):
        assert "".join(remark.split()) in output
    assert tempfile.gettempdir() not in output.replace("".join(str(log.parent).split()), "")
    if "--json" in arguments:
        assert json.loads(done.stdout)
    if arguments == ("report",):
        assert log.with_suffix(".html").read_text().count("its config.toml:") == len(REMARKS)


def remarks_on(log: Path) -> list[str]:
    reader = LogReader(log)
    list(reader)
    remarks = attached_configuration(reader)[1]
    assert len(remarks) == len(REMARKS)
    assert all(remark.startswith(f"{log}: its config.toml: ") for remark in remarks)
    return remarks


def test_a_replay_does_not_depend_on_the_configuration(log: Path) -> None:
    done = lowfc("replay", log)
    assert (done.exit_code, done.exception) == (0, None)
    assert "commands identical" in done.stdout


@pytest.mark.parametrize(("toml", "rate_hz"), [(OTHER_VERSION, 300.0), ("[camera", Configuration().camera.rate_hz)])
def test_a_view_uses_the_recorded_or_the_default_configuration(
    log_with: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, toml: str, rate_hz: float
) -> None:
    log, renderer = log_with(toml), Mock(wraps=Renderer)
    monkeypatch.setattr("lowfc.programs.view.recorded.Renderer", renderer)
    drawn = draw_logs([log], None, Tape())  # type: ignore[arg-type]
    assert [call.args[0].camera.rate_hz for call in renderer.call_args_list] == [rate_hz]
    assert str(log) in drawn.remarks[0]
    assert toml != OTHER_VERSION or drawn.remarks == remarks_on(log)


def test_an_acceptance_test_needs_a_configuration(log_with: Callable[[str], Path]) -> None:
    log = log_with("[camera")
    done = lowfc("acceptance", "noise-floor", log)
    assert isinstance(done.exception, DataFileError)
    assert "no configuration" in str(done.exception)
    assert f"{log}: its config.toml cannot be used" in done.stderr
