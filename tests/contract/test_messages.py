"""The wire contract: a schema that only grows, consistent topics and events.

After a new field: `python tests/contract/test_messages.py` rewrites `tests/golden/lowfc_v1.txt`.
"""

import ast
import re
import string
import subprocess
import sys
from collections.abc import Iterable, Iterator
from enum import IntEnum
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet

from lowfc.contract.codecs import codec
from lowfc.contract.events import EVENTS, Level
from lowfc.contract.messages import TOPICS, Log, RawImage, Role, from_timestamp, image, timestamp, topic_of, wire
from lowfc.control.loop.inputs import Command, Reply, Request, Step
from lowfc.control.loop.safety import REASONS, Limit, LoopMode

ROOT = Path(__file__).parents[2]
WIRE = ROOT / "lowfc" / "contract" / "wire"
GOLDEN = Path(__file__).parents[1] / "golden" / "lowfc_v1.txt"


def declared_package() -> FileDescriptorProto:
    """The package lowfc.v1 in the committed descriptor, with comments."""
    descriptors = FileDescriptorSet.FromString((WIRE / "lowfc.desc").read_bytes())
    return next(file for file in descriptors.file if file.package == "lowfc.v1")


def comments(file: FileDescriptorProto) -> dict[tuple[int, ...], str]:
    """Comment of each element, by the element's path in the descriptor."""
    return {
        tuple(location.path): " ".join(location.leading_comments.split()) for location in file.source_code_info.location
    }


def schema() -> list[str]:
    """One line for each field and each enum value: message, number, name, type, label, comment."""
    file, lines = declared_package(), []
    sentences = comments(file)
    for index, message in enumerate(file.message_type):
        for position, field in enumerate(message.field):
            kind = field.type_name.lstrip(".") or FieldDescriptorProto.Type.Name(field.type)[5:].lower()
            label = FieldDescriptorProto.Label.Name(field.label)[6:].lower()
            sentence = sentences.get((4, index, 2, position), "")
            lines.append(f"{message.name} | {field.number} | {field.name} | {kind} | {label} | {sentence}".rstrip())
    for index, enum in enumerate(file.enum_type):
        for position, value in enumerate(enum.value):
            sentence = sentences.get((5, index, 2, position), "")
            lines.append(f"{enum.name} | {value.number} | {value.name} | value | | {sentence}".rstrip())
    return lines


def test_the_schema_only_grows() -> None:
    """The golden file shows each change; tests/logs/test_golden.py compares the schema with that of version 0.1."""
    assert GOLDEN.read_text(encoding="utf-8").splitlines() == schema(), (
        "the schema has changed: existing numbers, names, types and labels must stay, and a new field needs a new "
        f"number; if they do, run `python {Path(__file__).relative_to(ROOT)}` and commit the golden file"
    )


def test_the_generated_code_matches_the_proto_file(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools", reason="needs grpcio-tools, which contains protoc, for development only")
    command = [sys.executable, "-m", "lowfc.contract.compile_proto", "--into", str(tmp_path)]
    subprocess.run(command, check=True, cwd=ROOT)
    generated = sorted(path.name for path in tmp_path.iterdir())
    assert generated == ["lowfc.desc", "lowfc_pb2.py", "lowfc_pb2.pyi"]
    for name in generated:
        assert (tmp_path / name).read_bytes() == (WIRE / name).read_bytes(), f"{name} is stale: run `make proto`"


@pytest.mark.parametrize(("enum", "prefix"), [(LoopMode, "LOOP_MODE_"), (REASONS, "REASON_")])
def test_enums_have_the_numbers_of_the_wire(enum: Iterable[IntEnum], prefix: str) -> None:
    numbers = dict((wire.LoopMode if enum is LoopMode else wire.Reason).items())
    assert numbers == {f"{prefix}UNSPECIFIED": 0} | {f"{prefix}{member.name}": member.value for member in enum}


def test_levels_have_the_numbers_of_foxgloves_schema() -> None:
    numbers = {value.name: value.number for value in Log.DESCRIPTOR.enum_types_by_name["Level"].values}
    assert numbers == {"UNKNOWN": 0} | {level.name: level.value for level in Level}


def test_every_message_and_every_field_has_a_comment() -> None:
    file = declared_package()
    sentences = comments(file)
    without_comment = [message.name for index, message in enumerate(file.message_type) if not sentences.get((4, index))]
    without_comment += [
        line for line in schema() if line.endswith("|") and " | timestamp | " not in line and " | 0 | " not in line
    ]
    assert without_comment == []


def test_topics_are_unique_and_found_by_their_keys() -> None:
    assert len({topic.key for topic in TOPICS}) == len(TOPICS)
    for topic in TOPICS:
        assert topic_of(topic.at("dm")) is topic
        assert [other.key for other in TOPICS if other.matches(topic.at("x"))] == [topic.key]
        assert topic.publishers
        assert Role.RECORDER in topic.subscribers
        assert "timestamp" in topic.message.DESCRIPTOR.fields_by_name
    for key in ("", "lowfc", "lowfc/mirror//command", "lowfc/mirror/dm", "lowfc/request/open"):
        with pytest.raises(KeyError):
            topic_of(key)


def test_only_frames_steps_commands_and_mirror_states_are_in_the_loop() -> None:
    keys = {topic.key for topic in TOPICS if topic.in_loop}
    assert keys == {
        "lowfc/camera/frame",
        "lowfc/control/step",
        "lowfc/mirror/{name}/command",
        "lowfc/mirror/{name}/state",
    }


def raised_events() -> Iterator[tuple[str, str, set[str]]]:
    """Place, name and detail keys of each event whose name is a literal where it is raised."""
    for package in ("lowfc", "sim_camera", "sim_dm"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if ".event(" in text or "PendingEvent(" in text:
                for scope in ast.walk(ast.parse(text)):
                    if isinstance(scope, ast.FunctionDef):
                        yield from _raised_in(scope, path)


def _raised_in(scope: ast.FunctionDef, path: Path) -> Iterator[tuple[str, str, set[str]]]:
    dicts = {
        ast.unparse(node.target): node.value
        for node in ast.walk(scope)
        if isinstance(node, ast.AnnAssign) and isinstance(node.value, ast.Dict)
    }
    for node in ast.walk(scope):
        if not isinstance(node, ast.Call) or not node.args or not isinstance(node.args[0], ast.Constant):
            continue
        called, where = ast.unparse(node.func), f"{path.relative_to(ROOT)}:{node.lineno}"
        if called == "PendingEvent":
            details = dicts.get(ast.unparse(node.args[1]), node.args[1])
            assert isinstance(details, ast.Dict), f"{where}: the details are not a dict that can be checked"
            yield where, node.args[0].value, {ast.literal_eval(key) for key in details.keys if key}
        elif called.endswith(".event") and all(keyword.arg for keyword in node.keywords):
            yield where, node.args[0].value, {str(keyword.arg) for keyword in node.keywords}


def details_of(description: str) -> set[str]:
    return {name for _, name, _, _ in string.Formatter().parse(description) if name}


def test_every_event_raised_by_its_literal_name_is_in_the_table_with_the_same_details() -> None:
    raised = list(raised_events())
    wrong = [
        f"{where}: {name} with {sorted(details)}"
        for where, name, details in raised
        if name not in EVENTS or details != details_of(EVENTS[name].description)
    ]
    assert wrong == []
    assert len(raised) > 25
    assert {"MODE_CHANGED", "CALIBRATION_LOADED", "COMMAND_EXPIRED"} <= {name for _, name, _ in raised}


@pytest.mark.parametrize("name", ["LIMIT_HIT", "LIMIT_CLEARED"])
def test_the_text_of_limit_events_is_also_true_of_modal_limits(name: str) -> None:
    message = EVENTS[name].log("controller", 0, reason=Limit.MODAL_LIMIT.name).message
    assert "mirror" not in message
    assert message.endswith(": MODAL_LIMIT")


def test_every_event_formats_as_a_line() -> None:
    for name, event in EVENTS.items():
        assert re.fullmatch(r"[A-Z]+(_[A-Z]+)*", name)
        log = event.log("controller", 1_500_000_000_123_456_789, **dict.fromkeys(details_of(event.description), 3))
        assert re.fullmatch(rf"{name} [^{{]*", log.message)
        assert log.level == event.level
        assert from_timestamp(log.timestamp) == 1_500_000_000_123_456_789


def test_a_frame_is_decoded() -> None:
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    time_ns = 1_767_225_600_123_456_789
    frame = codec.decode_frame(image(pixels, time_ns, "camera").SerializeToString(), 5, 9)
    assert (frame.sequence, frame.time_ns, frame.age_ns) == (5, time_ns, 9)
    assert np.array_equal(frame.pixels, pixels)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff\xff\xff",
        RawImage(width=4, height=3, step=8, encoding="mono16", data=bytes(23)).SerializeToString(),
        RawImage(width=4, height=3, step=4, encoding="mono8", data=bytes(12)).SerializeToString(),
        RawImage(width=0, height=0, step=0, encoding="mono16", data=b"").SerializeToString(),
        RawImage(width=4, height=3, step=9, encoding="mono16", data=bytes(27)).SerializeToString(),
    ],
)
def test_an_invalid_frame_has_no_pixels(payload: bytes) -> None:
    assert codec.decode_frame(payload, 1, 0).pixels is None


def test_steps_commands_and_requests_round_trip() -> None:
    modes, shape = np.array([1.5, -2.25], np.float32), np.arange(6, dtype=np.float32).reshape(2, 3)
    step = Step(9, 77, LoopMode.CLOSED, modes, (Limit.SLEW, Limit.NEIGHBOUR), modes + 1, modes + 2, 12.5, 3)
    sent = wire.ControlStep.FromString(codec.encode_step(step, 4))
    assert (sent.frame_sequence, from_timestamp(sent.timestamp), sent.mode) == (9, 77, wire.LOOP_MODE_CLOSED)
    assert sent.input_number == 4
    assert list(sent.reasons) == [wire.REASON_SLEW, wire.REASON_NEIGHBOUR]
    assert list(sent.command_nm) == modes.tolist()
    assert list(sent.error_nm) == (modes + 1).tolist()
    assert list(sent.pol_nm) == (modes + 2).tolist()
    assert (sent.flux_dn, sent.saturated_pixels) == (12.5, 3)

    command = wire.MirrorCommand.FromString(codec.encode_command(Command(9, 77, shape, modes), 5, "lowfc", 4))
    assert (command.frame_sequence, command.valid_for_ns, command.channel, command.input_number) == (9, 5, "lowfc", 4)
    assert np.array_equal(codec.actuators(command), shape)
    command.actuators += b"\0"
    assert codec.actuators(command) is None
    command.actuators = b""
    assert codec.actuators(command) is None

    request = Request(77, "gain", (2, 3), (0.5, 0.25))
    answered = codec.encode_request(request, Reply(True, "done", 10), 4, None)
    assert codec.decode_request(answered, "gain", 77) == request
    reply = wire.Request.FromString(answered)
    assert (reply.accepted, reply.reply, reply.frame_sequence, reply.input_number) == (True, "done", 10, 4)
    with pytest.raises(ValueError, match="could not be read"):
        codec.decode_request(b"\xff", "gain", 77)


def test_a_mirror_state_is_decoded() -> None:
    shape = np.arange(6, dtype=np.float32).reshape(2, 3)
    state = wire.MirrorState(timestamp=timestamp(77), rows=2, columns=3, actuators=shape.tobytes(), command_nm=[1, 2])
    decoded = codec.decode_mirror(state.SerializeToString())
    assert decoded.time_ns == 77
    assert np.array_equal(decoded.actuators_nm, shape)
    assert decoded.command_nm.tolist() == [1, 2]
    state.rows = 3
    assert codec.decode_mirror(state.SerializeToString()) is None
    assert codec.decode_mirror(b"\xff") is None


if __name__ == "__main__":
    GOLDEN.parent.mkdir(exist_ok=True)
    GOLDEN.write_text("\n".join(schema()) + "\n", encoding="utf-8")
    print(f"wrote {len(schema())} lines to {GOLDEN}")
