"""Files of released versions stay readable; a replay of their logs differs only where a rule changed on purpose."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from lowfc.adapters.files import calibration_file, factory, law_file
from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.contract import configuration, former_names
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import CONTROL_INPUT, wire
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Load, Request
from lowfc.control.loop.state import State
from lowfc.programs.logs.replay.former import CAMERA_RULE, CLEAR_RULE
from lowfc.programs.view.session import show_logs
from lowfc.programs.view.target import Target
from tests.golden import make
from tests.support.loops import json_of, refusal

WIRE = Path(__file__).parents[2] / "lowfc" / "contract" / "wire"
FOLDER = Path(__file__).parents[1] / "golden" / "0.1"
FORMER_KEY = "hold_ms"
NIGHT, KILLED = FOLDER / "night.mcap", FOLDER / "killed.mcap"
NIGHT_RULES = {CAMERA_RULE: 1, CLEAR_RULE: 1}
CALIBRATION_ID = "88418bc31223bb21a6b588e0b43a360fda6133511792fa03b8c6af46764afa20"
LAW_ID = "15560553d408bce3394be8a5123a916a091b94f0a6f0d423cc89d546b4e967f3"


@pytest.mark.parametrize(
    ("log", "bytes_cut", "frames", "changed"),
    [(NIGHT, 0, 163, NIGHT_RULES), (NIGHT, 5000, 163, NIGHT_RULES), (KILLED, 0, 18, {})],
)
def test_a_replay_is_identical_except_for_rules_that_changed_on_purpose(
    log: Path, bytes_cut: int, frames: int, changed: dict[str, int], tmp_path: Path
) -> None:
    """This holds also for a log without its beginning, which names the version of lowfc that wrote it."""
    path = tmp_path / "log.mcap"
    path.write_bytes(log.read_bytes()[bytes_cut:])
    # Linear algebra rounds differently on another processor; on the same one there must be no difference.
    results = json_of("replay", path, "--tolerance", 1e-3)
    assert (results["frames"], results["different"], results["unchecked"]) == (frames, 0, 0)
    assert results["rules_changed"] == changed
    complete = json_of("replay", log, "--tolerance", 1e-3) if bytes_cut else results  # the complete log names its host
    if not {"blas", "cpu_features", "numpy"} & complete["host_differs"].keys():
        assert (results["identical"], results["largest_difference_nm"]) == (True, 0.0)


def test_the_golden_files_of_the_present_version_can_be_made_and_replayed(tmp_path: Path) -> None:
    folder = tmp_path / "golden"
    make.main(folder)
    assert {path.name for path in folder.iterdir()} == {path.name for path in FOLDER.iterdir()}
    assert json_of("replay", folder / "night.mcap")["identical"]


def test_a_replay_with_another_blas_kernel_differs_only_by_rounding() -> None:
    command = [sys.executable, "-m", "lowfc", "replay", str(NIGHT), "--json", "--tolerance", "1e-3"]
    environment = os.environ | {"OPENBLAS_CORETYPE": "Prescott"}  # SSE3: every x86-64 processor since 2005 has it
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    results = json.loads(done.stdout)
    assert (done.returncode, results["different"], results["first_difference"]) == (0, 0, None)
    if "blas" in results["host_differs"]:
        assert 0 < results["largest_difference_nm"] < 1e-4


@pytest.mark.parametrize(
    "arguments",
    [
        *(["info", log] for log in (NIGHT, KILLED)),
        *(["report", NIGHT, "--out", "page.html"], ["report", KILLED]),
        *(["export", NIGHT, "--to", form, "--out", f"night.{form}"] for form in ("csv", "npz", "fits", "aot")),
        ["what-if", NIGHT, "--set", "gain=0.3"],
    ],
)
def test_a_command_reads_a_log_of_0_1(arguments: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert json_of(*arguments)


def test_a_killed_recorders_log_is_recovered_and_replays_as_before(tmp_path: Path) -> None:
    path = tmp_path / KILLED.name
    path.write_bytes(KILLED.read_bytes())
    assert json_of("recover", path)
    recovered = tmp_path / "killed-recovered.mcap"
    assert json_of("replay", recovered, "--tolerance", 1e-3)["frames"] == 18


def test_a_log_of_0_1_is_drawn(tmp_path: Path) -> None:
    out = tmp_path / "night.rrd"
    assert show_logs([NIGHT], None, Target(save=out))["remarks"] == []
    assert out.stat().st_size > 100_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tune", NIGHT, "--out", "law.fits"], "tuning requires at least"),
        (["acceptance", "linearity", NIGHT], "no `lowfc acceptance"),
    ],
)
def test_a_command_refuses_a_log_that_is_unsuitable_for_it(arguments: list[object], message: str) -> None:
    assert message in refusal(*arguments)


def test_the_log_of_0_1_has_every_kind_of_input() -> None:
    history = read_history(LogReader(NIGHT, skip_damaged=True))
    inputs = [wire.ControlInput.FromString(one.payload) for one in LogReader(NIGHT, topics=[CONTROL_INPUT])]
    assert {one.WhichOneof("input") for one in inputs} == {"load", "mirror", "camera", "tick"}
    names = {request.name for request in history.requests}
    assert {"law", "channel", "play", "offset", "load", "safe", "clear", "step", "reset", "note"} <= names
    assert any(not request.accepted for request in history.requests)
    assert any(state.HasField("law") for state in history.controllers)
    assert any(state.HasField("play") for state in history.controllers)


def test_identities_of_calibration_and_law_are_unchanged() -> None:
    assert calibration_file.load(FOLDER / "calibration.fits").identity() == CALIBRATION_ID
    assert law_file.load(FOLDER / "law.fits").id == LAW_ID


def test_messages_and_enumerations_of_0_1_are_unchanged_except_for_names() -> None:
    """No field of 0.1 has changed its number, type or label; only the names in `former_names` have changed."""
    former, now = {}, {}
    for declared, folder in ((former, FOLDER), (now, WIRE)):
        for file in FileDescriptorSet.FromString((folder / "lowfc.desc").read_bytes()).file:
            if file.package == "lowfc.v1":
                for message in file.message_type:
                    for field in message.field:
                        declared[message.name, field.number] = field.type, field.type_name, field.label, field.name
                for enum in file.enum_type:
                    declared |= {(enum.name, value.number): (value.name,) for value in enum.value}
    renamed = {
        (kind, number): (*shape, former_names.FIELDS.get(f"{kind}.{name}", former_names.VALUES.get(name, name)))
        for (kind, number), (*shape, name) in former.items()
    }
    assert {key: now.get(key) for key in renamed} == renamed
    names = {f"{kind}.{name}" for (kind, _), (*_, name) in former.items()}
    assert former_names.FIELDS.keys() <= names, "`former_names` has only names that 0.1 had"


def test_former_keys_of_a_configuration_give_a_remark() -> None:
    remarks: list[str] = []
    config = configuration.load(FOLDER / "lowfc.toml", remark=remarks.append)
    former = tomllib.loads((FOLDER / "lowfc.toml").read_text())
    assert config.sensor.modes == 2
    assert config.control.frame_timeout_ms == former["control"][FORMER_KEY]
    assert any(f"control.{FORMER_KEY} is now called control.frame_timeout_ms" in remark for remark in remarks)
    assert set(former_names.KEYS.values()) <= set(configuration.keys())


def test_a_key_under_its_former_and_its_present_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "lowfc.toml"
    path.write_text(f"[control]\n{FORMER_KEY} = 50\nframe_timeout_ms = 60\n")
    with pytest.raises(ConfigurationError, match=r"former name of control\.frame_timeout_ms, and both are present"):
        configuration.load(path)


def test_a_calibration_and_a_law_of_0_1_are_accepted_by_a_loop() -> None:
    config = configuration.load(FOLDER / "lowfc.toml")
    settings = factory.settings(config)
    state, _ = advance(settings, State(), Load(0, calibration_file.load(FOLDER / "calibration.fits"), "golden"))
    _, outputs = advance(settings, state, Request(0, "law", law=law_file.load(FOLDER / "law.fits")))
    assert outputs.reply.accepted, outputs.reply.text
