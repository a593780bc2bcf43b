"""The client of a running loop, its command line, and start and stop of recordings."""

import contextlib
import itertools
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Query, Sample
from lowfc.adapters.bus.other_loops import no_loop_message, other_loops
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Answer, Client, Frame, Stream, client, configuration_of, running, the_run
from lowfc.client.requests import DECLARED
from lowfc.client.runs import absence, waiting_message
from lowfc.client.stream import BUFFERED_MESSAGES, frame_of, step_of
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.bench_codec import decode_bench_value
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import count_of, sequence_of
from lowfc.contract.errors import BusError, CalibrationError, ConfigurationError, DataFileError, RequestRefusedError
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import (
    BENCH,
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    MIRROR_STATE,
    REQUEST_KEY,
    STEP,
    Log,
    Role,
    image,
    wire,
)
from lowfc.control.laws.linear_law import integrator_block, law_from_blocks
from lowfc.control.loop.inputs import Reply, Request, Step
from lowfc.control.loop.interlocks import Value
from lowfc.control.loop.requests import REQUESTS
from lowfc.control.loop.safety import Limit, LoopMode, Rejection
from lowfc.programs.cli.modes import noll_of
from lowfc.programs.cli.status import json_object, text
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.in_process_loop import ReportingBus
from tests.support.loops import json_of, lowfc, until
from tests.support.recording import Bench, bodies_of, put
from tests.support.toy import NOLL, calibration

LOADED = with_identity(calibration())
LAW = law_from_blocks([integrator_block(0.2, 0.01, "pol", 1.5)] * 3, "pol", "leaky", NOLL, 1.5, 1000.0)
LEASE = {"text": "a test", "lease_id": 7}
SHAPE = np.arange(20.0).reshape(LOADED.grid)


class FakeController:
    """Decodes requests as the controller does; answers with `reply`, or not at all if `silent`.

    The text of the answer to the request `configuration` is the attribute `configuration`.
    """

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.bus = MemoryBus(self.hub, "controller", HostClock())
        self.bus.queryable(REQUEST_KEY.format(name="*"), self._answer)
        self.calibrations = self.bus.publisher(CALIBRATION)
        self.calibrations.put(encode_calibration(LOADED, 0))
        self.states = self.bus.publisher(CONTROLLER_STATE)
        self.states.put(wire.ControllerState(calibration_id=LOADED.id).SerializeToString())
        self.requests: list[Request] = []
        self.reply = Reply(True, "done", 77)
        self.configuration = ""
        self.silent = False

    def _answer(self, query: Query) -> None:
        self.requests.append(codec.decode_request(query.payload, query.name, 0))
        if not self.silent:
            reply = self.reply._replace(text=self.configuration) if query.name == "configuration" else self.reply
            query.reply(codec.encode_request(self.requests[-1], reply, 1, None))


@pytest.fixture
def controller() -> FakeController:
    return FakeController()


@pytest.fixture
def loop(controller: FakeController) -> Client:
    return Client(bus=MemoryBus(controller.hub, "operator", HostClock()))


@pytest.fixture(autouse=True)
def short_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CONNECT_S", "ANSWER_S"):
        monkeypatch.setattr(client, name, 0.05)


REQUESTS_WITHOUT_FIELDS = ("open", "close", "pause", "safe", "clear", "reset", "stop")
METHODS = {"open": Client.open_loop, "close": Client.close_loop}
"""Methods whose name differs from that of their request."""
CALLS: tuple[tuple[Callable[[Client], object], Request], ...] = (
    *((METHODS.get(name) or getattr(Client, name), Request(0, name)) for name in ("status", *REQUESTS_WITHOUT_FIELDS)),
    (lambda loop: loop.step(7), Request(0, "step", (), (7.0,))),
    (lambda loop: loop.gain(0.5, [2, 3]), Request(0, "gain", (2, 3), (0.5,))),
    (lambda loop: loop.gain(0.5, modes=2), Request(0, "gain", (2,), (0.5,))),
    (lambda loop: loop.leak(np.float32([0.5, 0.25])), Request(0, "leak", (), (0.5, 0.25))),
    (lambda loop: loop.limit([20, 10], np.array([4, 2])), Request(0, "limit", (4, 2), (20.0, 10.0))),
    (lambda loop: loop.offset(), Request(0, "offset")),
    (lambda loop: loop.offset(5.0, np.int64(4)), Request(0, "offset", (4,), (5.0,))),
    (lambda loop: loop.channel("dark-hole", SHAPE), Request(0, "channel", text="dark-hole")),
    (lambda loop: loop.play(np.stack([SHAPE]), [[1], [3]]), Request(0, "play", text="mirror")),
    (lambda loop: loop.law(), Request(0, "law")),
    (lambda loop: loop.load(LOADED), Request(0, "load", calibration=LOADED)),
    (lambda loop: loop.note("höher"), Request(0, "note", text="höher")),
    *(
        (partial(Client.ask, name=name, values=10, text="a test", lease_id=7), Request(0, name, (), (10.0,), **LEASE))
        for name in ("lease", "renew", "permit")
    ),
    (lambda loop: loop.ask("release", lease_id=7), Request(0, "release", lease_id=7)),
    (lambda loop: loop.configuration(), Request(0, "configuration")),
)


@pytest.mark.parametrize(("call", "expected"), CALLS, ids=lambda value: getattr(value, "name", ""))
def test_the_controller_decodes_each_request(
    controller: FakeController, loop: Client, call: Callable[[Client], object], expected: Request
) -> None:
    answer = call(loop)
    assert controller.requests == [expected]
    expected_answer = (True, "done", 77, expected.text, None, "default")
    assert answer == ("" if expected.name == "configuration" else expected_answer)


def test_every_request_is_tested() -> None:
    assert {request.name for _, request in CALLS} == set(REQUESTS)


def test_every_request_names_its_requester(controller: FakeController, loop: Client) -> None:
    loop.safe()
    (request,) = controller.requests
    assert request.requester.endswith(f"(process {os.getpid()})")
    logged = wire.Request.FromString(codec.encode_request(request, controller.reply, 1, None))
    assert logged.requester == request.requester
    stripped = codec.only_requester(wire.Request(text="\0" * 5000, requester="ann").SerializeToString())
    assert stripped == wire.Request(requester="ann").SerializeToString()
    assert codec.only_requester(b"\xff" * 9000) == b""
    long = wire.Request(requester="a\n" * 200).SerializeToString()
    assert codec.decode_request(long, "open", 0).requester == "a\\n" * 50


def test_a_reservation_is_renewed_and_its_id_is_in_the_holders_requests(
    controller: FakeController, loop: Client
) -> None:
    with loop.reserved("a test", 30.0) as lease:
        loop.gain(0.1)
        loop.check_lease()
    loop.gain(0.2)
    _, first, gain, *renewals, release, after = controller.requests
    assert (first.name, first.lease_id, first.values) == ("lease", lease.id, (10.0,))
    assert first.text.startswith("a test by ")
    assert f"(process {os.getpid()}), about 30 s to go" in first.text
    assert (gain.name, gain.lease_id) == ("gain", lease.id)
    assert renewals
    assert {(renewal.name, renewal.lease_id) for renewal in renewals} == {("renew", lease.id)}
    assert (release.name, release.lease_id) == ("release", lease.id)
    assert after.lease_id == 0


def test_in_lockstep_a_reservation_lasts_as_long_as_the_controller_allows(
    controller: FakeController, loop: Client
) -> None:
    controller.configuration = "lockstep = true"
    with loop.reserved("a test"):
        loop.check_lease()
    _, *reservations, _ = controller.requests
    assert {request.values for request in reservations} == {(60.0,)}


def test_an_ended_reservation_gives_the_reason(controller: FakeController, loop: Client) -> None:
    with loop.reserved("a test"):
        controller.reply = Reply(False, "the lease ended: operator asked to open", 77)
        for _ in range(2):
            with pytest.raises(CalibrationError, match="reservation of the loop ended: operator asked to open"):
                loop.check_lease()


def test_frame_numbers_agree_in_status_stream_step_and_answer() -> None:
    sequence = sequence_of(1_800_000_000, 812)
    shown = json_object(wire.ControllerState(frame_sequence=sequence))["frame"]
    frame = Frame(sequence, 0, np.zeros((1, 1), np.uint16))
    step = Step(sequence, 0, LoopMode.CLOSED, np.zeros(3, np.float32), ())
    assert {shown, frame.number, step.frame, Answer(True, "done", sequence).frame} == {812}


def test_arrays_arrive_unchanged(controller: FakeController, loop: Client) -> None:
    loop.channel("dark-hole", SHAPE)
    loop.channel("dark-hole")
    loop.play(np.stack([SHAPE, -SHAPE]), [[1, 2], [3, 4], [5, 6]])
    loop.play_offset(np.ones((4, 3)))
    loop.law(LAW)
    loop.load(LOADED)
    shape, removed, played, offset, law, load = controller.requests
    assert np.array_equal(shape.actuators_nm, SHAPE.ravel())
    assert removed.actuators_nm.size == 0
    assert np.array_equal(played.actuators_nm, [*SHAPE.ravel(), *-SHAPE.ravel()])
    assert np.array_equal(played.table, [[1, 2], [3, 4], [5, 6]])
    assert (offset.text, offset.table.tolist()) == ("offset", np.ones((4, 3)).tolist())
    assert law.law.id == LAW.id
    assert load.calibration.id == LOADED.id


def test_a_refused_request_raises_an_error_with_the_controllers_reply(controller: FakeController, loop: Client) -> None:
    controller.reply = Reply(False, "the loop is in safe mode", 3)
    with pytest.raises(RequestRefusedError, match=r"^close refused: the loop is in safe mode \(run default\)$"):
        loop.close_loop()


@pytest.mark.parametrize(
    ("call", "why"),
    [
        (lambda loop: loop.gain(0.1, [-2]), "gain refused: .*-2"),
        (lambda loop: loop.gain("much"), "gain refused: .*much"),
        (lambda loop: loop.gain(0.4, modes=2.5), "gain refused: "),
        (lambda loop: loop.gain(0.4, modes="2"), "gain refused: "),
        (lambda loop: loop.gain(0.4, modes=[2, None]), "gain refused: "),
        (lambda loop: loop.gain(10**400), "gain refused: int too large"),
        (lambda loop: loop.channel("a", "file.fits"), "channel refused: could not convert"),
        (lambda loop: loop.gain(np.array(0.4 + 0j)), "gain refused: expected real numbers"),
        (lambda loop: loop.channel("a", np.ma.masked_equal(SHAPE, 2)), "channel refused: expected real numbers"),
        (lambda loop: loop.load("file.fits"), "load refused: expected Calibration, got 'file.fits'"),
        (lambda loop: loop.law("file.fits"), "law refused: expected LinearLaw, got 'file.fits'"),
        (lambda loop: loop.note(5), "note refused: expected str, got 5"),
        (lambda loop: loop.channel("a", []), r"got an array of shape \(0,\)"),
        (lambda loop: loop.channel("a", SHAPE.T), r"the mirror has actuators of shape \(4, 5\), got .* \(5, 4\)"),
        (lambda loop: loop.channel("a", SHAPE.ravel()), r"got an array of shape \(20,\)"),
        (lambda loop: loop.play(np.stack([SHAPE]), [[1, 2]]), r"got arrays of shape \(1, 20\) and \(1, 2\)"),
        (lambda loop: loop.play(SHAPE, [1, 2, 3, 4]), r"\(4, 5\) and \(4,\)"),
        (lambda loop: loop.play([[1, 2], [3]], [[1, 2]]), "play refused: "),
        (lambda loop: loop.play_offset([1, 2, 3]), r"takes a table \(frames, modes\)"),
        (lambda loop: loop.play_offset(np.zeros((3_000_000, 3))), "at most 16,000,000 bytes, got 36,000,0"),
    ],
)
def test_invalid_requests_are_refused_by_the_client(
    controller: FakeController, loop: Client, call: Callable[[Client], object], why: str
) -> None:
    with pytest.raises(RequestRefusedError, match=why):
        call(loop)
    assert controller.requests == []


def test_an_absent_and_a_silent_controller_give_different_errors(controller: FakeController, loop: Client) -> None:
    controller.silent = True
    with pytest.raises(BusError, match=r"the controller of run 'default' did not answer within 0.05 s"):
        loop.open_loop()
    with pytest.raises(BusError, match="run 'default' has no recorder: start one, as with `lowfc record`"):
        loop.record(True)
    controller.bus.close()
    for call in (loop.open_loop, loop.calibration):
        with pytest.raises(BusError, match="run 'default' has no controller: start one, as with `lowfc controller`"):
            call()


def test_a_controller_without_a_calibration_accepts_a_channel_of_the_mirrors_grid(
    controller: FakeController, loop: Client
) -> None:
    controller.states.put(wire.ControllerState(mirror_rows=4, mirror_columns=5).SerializeToString())
    assert loop.mirror_grid() == (4, 5)
    loop.channel("flat", SHAPE)
    assert [request.text for request in controller.requests] == ["flat"]
    with pytest.raises(RequestRefusedError, match=r"the mirror has actuators of shape \(4, 5\)"):
        loop.channel("flat", SHAPE.T)
    with pytest.raises(BusError, match=r"^no calibration is loaded in run 'default': `lowfc ctl load FILE` loads one"):
        loop.calibration()


def test_the_configuration_of_a_loop_is_read_and_that_of_another_version_is_refused(
    controller: FakeController, loop: Client
) -> None:
    for toml, rate_hz in ((Configuration().to_toml(), 250.0), ("[camera]\nrate_hz = 500.0\n", 500.0)):
        controller.configuration = toml
        assert configuration_of(loop).camera.rate_hz == rate_hz
    controller.configuration = "[camera]\nspeed = 3\n"
    with pytest.raises(
        ConfigurationError, match=r"another version of lowfc: unknown key .*camera\.speed.*; use the "
    ) as caught:
        configuration_of(loop)
    assert "\n" not in str(caught.value)


@pytest.fixture
def listen(own_runtime: Path) -> Iterator[Callable[..., None]]:
    """Return a function that opens the ports of a run's processes, as if they were running."""
    with contextlib.ExitStack() as open_sockets:

        def begin(name: str, *roles: str) -> None:
            ports = open_run(name).links.ports
            for role in roles:
                open_sockets.enter_context(socket.create_server(("127.0.0.1", ports[role])))

        yield begin


def test_runs_are_found_by_their_listening_processes(own_runtime: Path, listen: Callable[..., None]) -> None:
    where = rf"no loop of user \S+ is running here: {own_runtime}/lowfc was searched \(from XDG_RUNTIME_DIR\)"
    with pytest.raises(BusError, match=where):
        the_run(None)
    open_run("empty")
    listen("partial", "camera", "recorder")
    assert the_run(None) == the_run("partial") == "partial"
    with pytest.raises(BusError, match=r"there is no run 'empty': there is partial \(no controller yet\)$"):
        the_run("empty")
    listen("whole", "camera", "controller")
    assert running() == ["whole"]
    (open_run("damaged").path / "links.json").write_text("")
    assert (the_run("whole"), the_run("partial")) == ("whole", "partial"), "a damaged run does not affect others"
    with pytest.raises(BusError, match=r"more than one run is live: partial \(no controller yet\), whole; choose"):
        the_run(None)  # `partial` may be starting
    with pytest.raises(DataFileError, match=r"links\.json"):
        the_run("damaged")


def test_a_wait_for_a_run_without_processes_reports_the_other_runs(listen: Callable[..., None]) -> None:
    assert waiting_message("bnch").endswith("on this host yet; no other loop of yours is running")
    listen("bench", "camera", "controller")
    assert waiting_message("bench") == ""
    open_run("bnch")  # as the waiting process itself does
    assert waiting_message("bnch").endswith("on this host yet; running: bench (did you mean 'bench'?)")


def test_the_message_about_an_absent_process_names_a_start_a_stop_or_a_restarted_run(
    listen: Callable[..., None],
) -> None:
    open_run("night", listeners=(Role.LAUNCHER,))
    listen("night", "launcher", "recorder")
    assert (
        absence("night", Role.CONTROLLER) == "run 'night' is starting, and its controller is not there yet: try again"
    )
    assert "the recorder of run 'night' does not answer, but its port is in use" in absence("night", Role.RECORDER)
    open_run("dusk", listeners=(Role.LAUNCHER,))
    listen("dusk", "launcher", "controller")
    assert "was started with --no-record" in absence("dusk", Role.RECORDER)
    listen("bench", "camera")
    for run in ("bench", "noon"):  # runs that `lowfc sim-loop` did not start
        assert absence(run, Role.CONTROLLER).startswith(f"run '{run}' has no controller: start one")
    with Client("bench") as loop:
        (open_run("bench").path / "links.json").touch()
        with pytest.raises(BusError, match="run 'bench' was started again: join it again, with a new Client"):
            loop.status()
    with pytest.raises(BusError, match="lowfc/camera/frame cannot be used: session closed"):
        loop.frames()


def test_an_unambiguous_beginning_of_a_name_selects_a_run(listen: Callable[..., None]) -> None:
    for name in ("night", "night-2", "noon"):
        listen(name, "controller")
    assert [the_run(beginning) for beginning in ("night", "night-", "noo")] == ["night", "night-2", "noon"]
    with pytest.raises(BusError, match=r"'n' is the beginning of several runs' names: night, night-2, noon$"):
        the_run("n")
    with pytest.raises(BusError, match=r"there is no run 'day': there are night, night-2, noon$"):
        the_run("day")
    with pytest.raises(BusError, match=r"noon \(did you mean 'night'\?\)$"):
        the_run("ngiht")
    with pytest.raises(BusError, match="there is no run 'nnn"):
        the_run("n" * 300)  # longer than any file's name
    open_run("noo")  # a stopped run: its name must not select the run "noon"
    with pytest.raises(BusError, match="there is no run 'noo'"):
        the_run("noo")


def test_a_loop_outside_this_runtime_directory_is_reported(own_runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report has the loop's owner, its process and, if readable, its runtime directory.

    A loop of the same user in the same directory is reported as starting. A shell that has a loop's command as
    arguments is not reported.
    """
    name = f"night-{os.getpid()}"
    arguments = [sys.executable, "-c", "print(flush=True); input()", "lowfc", "controller", "--run", name]
    shell = ["/bin/sh", "-c", 'echo; read end; "$@"', *arguments[3:]]
    start_child = "import subprocess, sys; subprocess.run(sys.argv[3:])"
    parent = [sys.executable, "-c", start_child, "lowfc", "sim-loop", *arguments]
    for runtime_dir, command in (
        ("/run/elsewhere", arguments),
        ("", arguments),
        (str(own_runtime), [*arguments[:-2], f"--run={name}"]),
        (str(own_runtime), shell),
        ("/run/elsewhere", parent),
    ):
        environment = os.environ | {"XDG_RUNTIME_DIR": runtime_dir}
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process:
            process.stdout.readline()
            own_loops = [other for other in other_loops() if f"(process {process.pid})" in other[0] or name in other[0]]
            message = no_loop_message()
            with monkeypatch.context() as patch:
                patch.setattr("lowfc.adapters.bus.other_loops._START_S", 0.0)
                later_message = no_loop_message()
                patch.setattr(os, "geteuid", lambda: 4_000_000_000)
                patch.setenv("XDG_RUNTIME_DIR", runtime_dir)
                seen_by_other_user = list(other_loops())
            process.communicate(b"\n")
        program = "sim-loop" if command is parent else "controller"
        loop = f"`lowfc {program} --run {name}` (process {process.pid})"
        where = f", with XDG_RUNTIME_DIR={runtime_dir}" if runtime_dir else ", without XDG_RUNTIME_DIR"
        is_loop, starting = command is not shell, runtime_dir == str(own_runtime)
        assert own_loops == [(f"you run {loop}{'' if starting else where}", starting)] * is_loop
        assert ((f"user {own_runtime.owner()} runs {loop}{where}", False) in seen_by_other_user) == is_loop
        assert message.endswith("starting or ending: try again in a few seconds") == (is_loop and starting)
        assert (f"{loop}, but its directory is gone" in later_message) == (is_loop and starting)


# The mirror.


def test_mirror_watch_reports_restarts_and_expired_commands_and_ignores_damaged_messages() -> None:
    hub = MemoryHub()

    def start(role: str) -> Callable[[int], object]:
        """Start a mirror; return a function that reports the mirror's newest frame."""
        states = MemoryBus(hub, role, HostClock()).publisher(MIRROR_STATE, role.removeprefix("mirror-"))
        return lambda frame: states.put(wire.MirrorState(frame_sequence=frame).SerializeToString())

    slow, quick = start("mirror-slow"), start("mirror-quick")
    bus = ReportingBus(hub, lambda: slow(1))
    watch = Client(bus=bus).mirror_watch()
    assert (watch.frame_sequence, watch.interruption) == (1, "")
    slow(7)
    quick(9)
    for topic, name in ((MIRROR_STATE, "slow"), (EVENT, "")):
        bus.publisher(topic, name).put(b"\xff")
    bus.publisher(EVENT).put(EVENTS["COMMAND_BACK"].log("mirror-slow", 0).SerializeToString())
    watch.read()
    assert (watch.frame_sequence, watch.interruption) == (7, "")
    start("mirror-quick")(10)
    watch.read()
    assert (watch.frame_sequence, watch.interruption) == (7, "the mirror 'quick' restarted")
    expired = EVENTS["COMMAND_EXPIRED"].log("mirror-slow", 0, command_timeout_ms=200.0, action="holding the shape")
    bus.publisher(EVENT).put(expired.SerializeToString())
    watch.read()
    assert watch.interruption.startswith("mirror-slow was without commands for too long (COMMAND_EXPIRED ")


@pytest.mark.parametrize(("refused", "why"), [(Rejection.NO_MIRROR, "its driver failed"), (0, "the last one expired")])
def test_mirror_watch_reports_a_mirror_that_did_not_follow_commands(refused: int, why: str) -> None:
    hub = MemoryHub()
    states = MemoryBus(hub, "mirror-dm", HostClock()).publisher(MIRROR_STATE, "dm")

    def report(status: int, refused: int = 0) -> None:
        states.put(wire.MirrorState(status=status, refused=refused).SerializeToString())

    watch = Client(bus=ReportingBus(hub, lambda: report(wire.MIRROR_STATUS_EXPIRED))).mirror_watch()
    report(wire.MIRROR_STATUS_FOLLOWING)
    watch.read()
    assert watch.interruption == "", "the state EXPIRED before the first state FOLLOWING is no interruption"
    report(wire.MIRROR_STATUS_EXPIRED, refused)
    report(wire.MIRROR_STATUS_FOLLOWING)
    watch.read()
    assert watch.interruption == f"the mirror 'dm' did not follow commands, because {why}"


# Streams.


def frame_sample(count: int, start_s: int = 1_700_000_000) -> Sample:
    pixels = np.full((3, 4), count, np.uint16)
    return Sample(
        FRAME.key, image(pixels, count * 1000, "camera").SerializeToString(), sequence_of(start_s, count), 0, 0
    )


def stream(*samples: Sample, count: int | None = None) -> Stream[client.Frame]:
    drained = itertools.chain([samples], itertools.repeat(()))
    return Stream(SimpleNamespace(drain=lambda: next(drained), close=lambda: None), frame_of, "frame", count, 0.02)


def test_frames_arrive_in_order_as_arrays() -> None:
    frames = list(stream(*map(frame_sample, range(5, 15)), count=4))
    assert [frame.pixels[0, 0] for frame in frames] == [5, 6, 7, 8]
    assert [(frame.number, frame.time_ns) for frame in frames] == [(5, 5000), (6, 6000), (7, 7000), (8, 8000)]
    assert (frames[0].pixels.shape, frames[0].pixels.dtype) == ((3, 4), np.uint16)
    assert list(stream(frame_sample(5), count=-1)) == []


def test_lost_frames_are_counted_but_not_restarts_or_duplicates() -> None:
    before_1970 = image(np.zeros((3, 4), np.uint16), -1, "camera").SerializeToString()
    restarted = [frame_sample(count, 1_700_000_060) for count in (0, 2)]
    for payload in (b"\xff", before_1970):
        broken = frame_sample(9)._replace(payload=payload)
        frames = stream(frame_sample(5), frame_sample(8), broken, frame_sample(10), *restarted, count=5)
        assert len(list(frames)) == 5
        assert frames.lost == 2 + 1 + 1, "frames 6 and 7, the unreadable frame 9, and frame 1 after the restart"
    earlier_start = frame_sample(2, 1_699_999_000)
    frames = stream(*map(frame_sample, (5, 7, 7, 6)), earlier_start, *map(frame_sample, (8, 8, 11, 10)), count=9)
    assert [frame.number for frame in frames] == [5, 7, 7, 6, 2, 8, 8, 11, 10]
    assert frames.lost == 1, "only frame 9 is missing"


def test_a_silent_stream_raises_an_error_even_at_its_start() -> None:
    frames = stream(frame_sample(1))
    next(frames)
    with pytest.raises(BusError, match=r"no frame came within 0.02 s: `lowfc ctl status` shows why"):
        next(frames)
    with pytest.raises(BusError, match="no frame came"):
        stream()
    broken = frame_sample(2)._replace(payload=b"\xff")
    with pytest.raises(BusError, match=r"no frame came within 0.02 s \([0-9]{1,5} could not be read\)"):
        next(stream(*[broken] * 100_000))


def test_an_ended_stream_unsubscribes(controller: FakeController) -> None:
    publisher = controller.bus.publisher(FRAME)
    bus = ReportingBus(controller.hub, lambda: [publisher.put(frame_sample(count).payload) for count in range(3)])
    loop, before = Client(bus=bus), list(bus._subscriptions)
    assert [frame.pixels[0, 0] for frame in loop.frames(2)] == [0, 1], "from the first frame after the call"
    assert bus._subscriptions == before
    frames = loop.frames(patience_s=0.02)
    with pytest.raises(BusError):
        list(frames)
    assert bus._subscriptions == before
    assert list(frames) == []


def test_a_slow_reader_loses_the_oldest_frames(controller: FakeController, loop: Client) -> None:
    ring = loop._bus.ring(FRAME, BUFFERED_MESSAGES)
    publisher = controller.bus.publisher(FRAME)
    payload = frame_sample(1).payload
    for _ in range(BUFFERED_MESSAGES + 30):
        publisher.put(payload)
    frames = Stream(ring, frame_of, "frame", BUFFERED_MESSAGES, 0.02)
    first = next(frames)
    for _ in range(5):
        publisher.put(payload)
    assert first.number == 30
    assert len(list(frames)) == BUFFERED_MESSAGES - 1
    assert frames.lost == 0, "frames lost before the first one that was read do not count"


@pytest.mark.parametrize("payload", [b"\xff", b""])
def test_an_invalid_answer_gives_an_error_that_names_it(payload: bytes) -> None:
    hub = MemoryHub()
    controller = MemoryBus(hub, "controller", HostClock())
    controller.queryable(REQUEST_KEY.format(name="*"), lambda query: query.reply(b"\xff"))
    controller.publisher(CALIBRATION).put(payload)
    controller.publisher(CONTROLLER_STATE).put(wire.ControllerState(calibration_id="abc").SerializeToString())
    loop = Client(bus=MemoryBus(hub, "operator", HostClock()))
    with pytest.raises(BusError, match=r"the answer to safe is not a lowfc\.v1\.Request"):
        loop.safe()
    with pytest.raises(BusError, match="the answer to lowfc/calibration is not a "):
        loop.calibration()


def test_a_step_is_decoded_unchanged() -> None:
    command_nm = np.array([1.5, -2.0, 0.25], np.float32)
    sent = Step(9, 5_000, LoopMode.CLOSED, command_nm, (Limit.SLEW,), command_nm + 1, command_nm + 2, 1234.5, 3)
    received = step_of(Sample(STEP.key, codec.encode_step(sent, 1), 0, 0, 0))
    for name in Step._fields:
        assert np.array_equal(getattr(received, name), getattr(sent, name)), name
    held = step_of(Sample(STEP.key, codec.encode_step(sent._replace(error_nm=None, pol_nm=None), 1), 0, 0, 0))
    assert (held.error_nm, held.pol_nm) == (None, None)
    assert step_of(Sample(STEP.key, b"\xff", 0, 0, 0)) is None


def test_held_holds_the_loop_and_releases_it_after_an_error(controller: FakeController, loop: Client) -> None:
    assert loop.permit("moving the mask").accepted
    with pytest.raises(KeyError), loop.held("moving the mask", 5.0):
        raise KeyError
    permission, hold, release = controller.requests
    assert [request.name for request in controller.requests] == ["permit", "permit", "release"]
    assert (permission.values, hold.values) == ((), (5.0,))
    assert hold.text.startswith("moving the mask by ")
    assert hold.lease_id == release.lease_id != permission.lease_id


@pytest.mark.parametrize("value", [True, np.bool_(True), 3, np.int64(3), 2.5, "parked"])
def test_a_bench_value_arrives_unchanged(controller: FakeController, loop: Client, value: Value) -> None:
    received: list[Sample] = []
    controller.bus.subscribe(BENCH, received.append, "mask")
    for _ in range(2):
        loop.bench("mask", value)
    loop.bench("another", value)
    decoded = [decode_bench_value(sample.payload) for sample in received]
    assert decoded == [value, value]
    assert isinstance(decoded[0], bool) is isinstance(value, bool | np.bool_)
    invalid: list[tuple[Any, Value]] = [("a b", True), ("1st", True), (5, True), (None, True)]
    invalid += [("mask", wrong) for wrong in (float("nan"), 10**400, [1], "x" * 201, "\ud800")]
    for name, wrong in invalid:
        with pytest.raises(ConfigurationError, match=str(name)):
            loop.bench(name, wrong)


# The table of requests and the command line.


def test_the_declared_requests_match_the_implemented_ones() -> None:
    by_key = {declared.key: declared for declared in DECLARED}
    assert len(by_key) == len(DECLARED)
    assert list(by_key) == [
        *(REQUEST_KEY.format(name=name) for name in REQUESTS),
        "lowfc/record/start",
        "lowfc/record/stop",
    ]
    fields = set(wire.Request.DESCRIPTOR.fields_by_name)
    assert all({name for name, _ in declared.fields} <= fields for declared in DECLARED)
    assert all(not by_key[REQUEST_KEY.format(name=name)].fields for name in REQUESTS_WITHOUT_FIELDS)


def test_mode_lists_are_parsed() -> None:
    assert noll_of(None) == ()
    assert noll_of(["2", "3"]) == noll_of(["2,3"]) == (2, 3)
    assert noll_of(["4-7, 11"]) == (4, 5, 6, 7, 11)
    assert noll_of(["3,2-4"]) == (3, 2, 4)
    for invalid in ("0", "x", "2-", "-2", "2.5", "11-4", "2,11-4", "", ",", "2-9999999999"):
        with pytest.raises(ConfigurationError, match="as in 2,3 or 4-11"):
            noll_of([invalid])


def test_an_invalid_number_is_quoted_in_the_error() -> None:
    for arguments in (["gain", "0,3"], ["limit", "60", "0,3"], ["offset", "-5", "0,3"]):
        done = lowfc("ctl", *arguments)
        assert done.exit_code == 2
        assert "'0,3' is not a number: write 0.3" in done.output
    assert "'4=-5' is not a number: write -5 --modes 4" in lowfc("ctl", "offset", "4=-5").output
    assert "'1.5' is not a whole number" in lowfc("ctl", "step", "1.5").output
    assert isinstance(lowfc("ctl", "gain", "auto", "0.3").exception, ConfigurationError)
    bench = ("ctl", "bench", "--run", "none-such", "celsius")
    assert "'-x' is neither an option of this command nor a number" in lowfc(*bench, "-x").output
    assert isinstance(lowfc(*bench, "-40").exception, BusError | DataFileError), "a negative value is no option"


def test_the_status_shows_the_whole_state() -> None:
    shape, reached = (np.float32(values).tobytes() for values in ([3, 4], [3, 3]))
    state = wire.ControllerState(
        mode=wire.LOOP_MODE_CLOSED,
        frame_sequence=(5 << 32) + 107,
        gain=[0.5, 0.25],
        offset_nm=[3, -4],
        command_history_nm=[6, 8, 1, 1],
        steps_left=12,
        calibration_id="abc",
        calibration_provisional=True,
        limits_hit=[wire.REASON_SLEW],
        law=wire.LinearLaw(name="lqg"),
        law_frames=150,
        play=wire.Play(target="mirror", first_sequence=(5 << 32) + 100, columns=2, table=bytes(8 * 20)),
        channels=[wire.Channel(name="dark-hole", actuators=shape, shifts=True, reached=reached)],
    )
    expected = {
        "mode": "closed",
        "frame": 107,
        "steps_left": 12,
        "command_rms_nm": 10.0,
        "offset_rms_nm": 5.0,
        "law": {"name": "lqg", "weight": 0.5, "overruled": []},
        "playing": {"target": "mirror", "frames": 20, "frames_left": 12},
        "channels": [{"name": "dark-hole", "rms_nm": 12.5**0.5, "shifts_zero_point": True, "reached": False}],
        "limits_hit": ["SLEW"],
        "calibration_provisional": True,
    }
    shown = json_object(state)
    assert {name: shown[name] for name in expected} == expected
    phrases = ["closed, opens after 12 frames", "dark-hole 3.54 nm rms", "12 of 20", "acting: slew", "integrator only"]
    assert [phrase for phrase in phrases if phrase not in text(shown)] == []
    assert text(shown).splitlines()[-1].endswith("abc, provisional: from the first steps of commissioning")
    assert json_object(wire.ControllerState())["mode"] == "starting"
    assert "provisional" not in text(json_object(wire.ControllerState(calibration_id="abc")))
    counts = [wire.ReasonCount(reason=42, count=3)]
    state_of_newer_version = wire.ControllerState(mode=9, refused=40, limits_hit=[41], counts=counts)
    shown = json_object(state_of_newer_version)
    assert [shown[key] for key in ("mode", "refused", "limits_hit", "counts")] == ["mode 9", "40", ["41"], {"42": 3}]
    assert "reason 42 3 times" in text(shown)


# Start and stop of recordings.


@pytest.fixture
def bench(own_runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr(client, "SLOW_ANSWER_S", 10.0)
    return Bench(own_runtime / "logs")


def test_a_recording_is_stopped_and_restarted(bench: Bench) -> None:
    put(bench.controller.publisher(CALIBRATION), 1)
    states = bench.camera.publisher(CAMERA_STATE)
    frames = bench.camera.publisher(FRAME)
    # Lose one frame of each recording: the first has frames 0 to 49, the second begins with frame 90.
    bench.hub.lose = lambda role, key, envelope: (
        role == "recorder" and key == FRAME.key and count_of(envelope.sequence) in (5, 95)
    )
    bench.start()
    operator = Client(bus=bench.bus)
    first = put(frames, 50)
    stopped = Path(operator.record(False).text)
    assert stopped.is_absolute()
    reader = LogReader(stopped)
    read = list(reader)
    assert reader.complete
    assert bodies_of(read, FRAME) == first[:5] + first[6:]
    events = [Log.FromString(body).message for body in bodies_of(read, EVENT)]
    assert "RECORDING_STOPPED recording stopped: operator asked" in events
    put(frames, 40)
    put(states, 1)
    with pytest.raises(RequestRefusedError, match="nothing is being recorded"):
        operator.record(False)
    until(lambda: not len(bench.recorder._backlog))
    started = operator.record(True)
    with pytest.raises(RequestRefusedError, match="recording is already in progress"):
        operator.record(True)
    second = put(frames, 30)
    operator.record(False)
    put(frames, 10)
    (answer,) = bench.bus.get("lowfc/record/dance", timeout_s=10)
    assert not wire.Request.FromString(answer.payload).accepted
    summary = bench.stop()
    assert [path.absolute() for path in summary.files] == [stopped, Path(started.text)]
    read = list(LogReader(summary.files[1]))
    # A log begins with the last calibration and the last state of the camera, published before it.
    assert [message.key for message in read[:2]] == [CALIBRATION.key, CAMERA_STATE.key]
    assert bodies_of(read, FRAME) == second[:5] + second[6:]
    assert "RECORDING recording" in [Log.FromString(body).message for body in bodies_of(read, EVENT)]
    assert (summary.lost, summary.failure) == ({FRAME.key: 2}, ""), "frames between the recordings do not count as lost"
    logs = [LogReader(path) for path in summary.files]
    counts = [len(list(log)) for log in logs]
    assert summary.messages == sum(counts)
    for log, count in zip(logs, counts, strict=True):
        account = {"messages": str(count), "messages_lost": "1", f"lost {FRAME.key}": "1"}
        assert log.metadata["recording"] == account, "the counts are those of this recording, not of all recordings"


def test_a_log_that_cannot_be_created_is_refused_and_the_answer_to_the_next_start_estimates_the_growth(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.start(bytes_per_s=1e6)
    operator = Client(bus=bench.bus)
    stopped = operator.record(False)
    assert stopped.reply == f"recording stopped: {stopped.text}"
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda folder: Path(os.devnull, "x").stat())
        with pytest.raises(RequestRefusedError, match="cannot be accessed: Not a directory"):
            operator.record(True)
    moved = bench.folder.with_name("elsewhere")
    bench.folder.rename(moved)
    bench.folder.write_text("a file")
    with pytest.raises(RequestRefusedError, match="is no folder"):
        operator.record(True)
    bench.folder.unlink()
    moved.rename(bench.folder)
    second = operator.record(True)
    assert second.text != stopped.text
    assert second.reply.startswith(f"recording into {second.text}; about 3.6 GB an hour; ")
    shutil.rmtree(bench.folder)  # ends the recording with a failure; another can follow
    until(lambda: bench.camera.last_health["recorder"].recording.failure)
    third = operator.record(True).text
    summary = bench.stop()
    assert (len(summary.files), str(summary.files[-1].absolute())) == (3, third)
    assert (summary.failure, bench.camera.last_health["recorder"].recording.failure) == ("", "")


def test_contrast_is_estimated_for_a_real_camera_and_true_for_a_simulated_one() -> None:
    estimate = {"added_contrast_flat": 2e-9, "added_contrast": 3e-11}
    measured = wire.Health(last_second={"frames": 9}, recent_wavefront=estimate)
    true = wire.Health(recent_wavefront={"added_contrast_flat": 4e-9, "added_contrast": 5e-11})
    processes = {Role.CAMERA: wire.Health(), Role.CONTROLLER: measured}
    real, simulated = (json_object(wire.ControllerState(), processes | camera) for camera in ({}, {Role.CAMERA: true}))
    assert real["added_contrast"] == {"open": 2e-9, "closed": 3e-11}
    assert "+3.0e-11, estimated from the sensor" in text(real)
    assert simulated["added_contrast"] == {"open": 4e-9, "closed": 5e-11}
    assert "estimated" not in text(simulated)


def test_a_configuration_with_values_that_json_lacks_is_printed_as_json(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = SimpleNamespace(run_id="bench", configuration=lambda: "[drivers.own]\nsince = 2026-01-31\nlimit = -inf\n")
    monkeypatch.setattr("lowfc.programs.cli.ctl._client", lambda run: contextlib.nullcontext(loop))
    shown = json_of("ctl", "configuration")
    assert shown == {"drivers": {"own": {"since": "2026-01-31", "limit": "-Infinity"}}}
