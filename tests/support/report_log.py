"""A log of the loop of `tests.support.toy`, from the real controller's `advance`, without processes."""

from collections.abc import Callable, Collection
from copy import copy, deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files import calibration_file
from lowfc.adapters.logs.writer import Attachment, LogWriter
from lowfc.arrays import Pixels, Single
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.codecs.law_codec import wire_law
from lowfc.contract.codecs.state_codec import controller_state
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import sequence_of
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    LAW,
    MIRROR_STATE,
    REQUEST,
    STEP,
    TIMING,
    TRUTH,
    Message,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import integrator
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Frame, Load, Outputs, Request
from lowfc.control.loop.state import State
from tests.support.toy import FLUX_DN, NOLL, PERIOD_NS, SHAPE, START, TOY, calibration, settings

TOY_CALIBRATION = with_identity(calibration())
DELAY_NS = 300_000  # shortest time from a frame to its command
READ_NOISE_E = 2.0
METADATA = {"lowfc": {"lowfc": "0.1.0", "numpy": "2.0", "host": "bench", "run": "night", "seed": "5"}}


class SyntheticLog:
    """Messages of a run, appended frame by frame; the x tilt disturbance is a sine of 12 nm amplitude, 7 Hz."""

    def __init__(self, *, truth: bool = True, calibration: Calibration = TOY_CALIBRATION, **changes: object) -> None:
        """Start a loop with `changes` to its settings."""
        self.samples: list[Sample] = []
        self.truth = truth
        self.instants = 0  # `instants` of each truth; above 0, the continuous modes are twice the sampled ones
        self.now_ns = START * 10**9
        self.calibration = calibration
        self.settings = settings(**({"gain": (0.4, 0.2)} | changes))
        self._rng = np.random.default_rng(8)
        self._counts: dict[tuple[str, int], int] = {}
        self._camera_start = START
        self._count = self._frames = 0
        self._to_modes = np.linalg.pinv(self.calibration.modes_to_actuators)
        self._dark_dn = self.calibration.dark.reshape(SHAPE).astype(float)
        self._mirror_nm = np.zeros(len(NOLL), np.float32)
        self.start_controller()
        camera = wire.CameraState(
            period_ns=PERIOD_NS,
            exposure_ns=PERIOD_NS // 2,
            gain_e_per_dn=1.0,
            read_noise_e=READ_NOISE_E,
            em_gain=1.0,
            bit_depth=16,
        )
        self.put(CAMERA_STATE, camera)

    def copy(self) -> Self:
        """An independent copy, which further messages can continue."""
        other = copy(self)
        other.samples, other._counts, other._rng = [*self.samples], {**self._counts}, deepcopy(self._rng)
        return other

    def start_controller(self) -> None:
        """Start a new controller, without the state of the previous one."""
        self.event("STARTED", process="controller", version="0.1.0")
        self._state = State()
        self.load(self.calibration)

    def load(self, calibration: Calibration) -> None:
        """Load a calibration; the dark of the frames and the modes of the mirror remain those of the first one."""
        self.put(CALIBRATION, encode_calibration(calibration, self.now_ns))
        self._publish(advance(self.settings, self._state, Load(self.now_ns, calibration, "test")))

    def start_camera(self) -> None:
        self._camera_start += 60
        self._count = 0

    def frames(self, number: int, *, lost: Collection[int] = (), dark: Collection[int] = ()) -> Self:
        """Append frames; those in `lost` never reach the controller, those in `dark` have no light."""
        for index in range(number):
            self.now_ns += PERIOD_NS
            sequence = sequence_of(self._camera_start, self._count)
            time_s = self._frames * PERIOD_NS * 1e-9
            wave_nm = np.array([12 * np.sin(2 * np.pi * 7 * time_s), 3.0, -2.0], np.float32)
            residual_nm = wave_nm + self._mirror_nm
            frame = self._pixels(residual_nm, 0.0 if index in dark else FLUX_DN)
            self._count, self._frames = self._count + 1, self._frames + 1
            self.put(FRAME, image(frame, self.now_ns, "sensor"), sequence)
            if self.truth:
                truth = wire.Truth(
                    timestamp=timestamp(self.now_ns),
                    frame_sequence=sequence,
                    disturbance_nm=wave_nm,
                    residual_nm=residual_nm,
                    disturbance_rms_nm=np.linalg.norm(wave_nm),
                    residual_rms_nm=np.linalg.norm(residual_nm),
                )
                if self.instants:
                    truth.instants = self.instants
                    truth.sensed_residual_nm.extend(residual_nm)
                    truth.continuous_disturbance_nm.extend(2 * wave_nm)
                    truth.continuous_residual_nm.extend(2 * residual_nm)
                self.put(TRUTH, truth)
            if index not in lost:
                exposed = Frame(sequence, self.now_ns, 100_000, frame)
                self._publish(advance(self.settings, self._state, exposed), DELAY_NS + 1000 * (self._count % 50))
        return self

    def request(self, name: str, values: tuple[float, ...] = (), modes: tuple[int, ...] = (), **fields: Any) -> Self:
        request = Request(self.now_ns, name, modes, values, **fields)
        before = self._state
        after, outputs = advance(self.settings, before, request)
        self.put(REQUEST, codec.encode_request(request, outputs.reply, after.input_number, None))
        self._publish((after, outputs))
        return self

    def law(self, gain: float, *, logged: bool = True) -> None:
        """Load an integrator of one gain as a linear law named pi; its matrices are in the log only if `logged`."""
        law = replace(integrator([gain] * len(NOLL), [0.0] * len(NOLL), NOLL, 1.0, 1e9 / PERIOD_NS), name="pi")
        if logged:
            self.put(LAW, wire_law(law))
        self.request("law", law=law)

    def event(self, name: str, **details: object) -> None:
        self.put(EVENT, EVENTS[name].log("controller", self.now_ns, **details))

    def health(self, process: str, **fields: object) -> Self:
        self.put(HEALTH, wire.Health(process=process, **fields), name=process)
        return self

    def put(
        self, topic: Topic, message: Message | bytes, sequence: int | None = None, name: str = "dm", late_ns: int = 0
    ) -> None:
        """Append a message, by default with the next sequence of its topic."""
        key = topic.at(name)
        if sequence is None:
            count = self._counts[key, START] = self._counts.get((key, START), -1) + 1
            sequence = sequence_of(START, count)
        payload = message if isinstance(message, bytes) else message.SerializeToString()
        sent_ns = self.now_ns + late_ns
        self.samples.append(Sample(key, payload, sequence, sent_ns, sent_ns + 50_000))

    def indices(self, topic: Topic) -> list[int]:
        """Indices of the samples of a topic."""
        return [index for index, one in enumerate(self.samples) if topic.matches(one.key)]

    def messages(self, topic: Topic) -> list[Any]:
        """Decoded messages of a topic."""
        return [topic.message.FromString(self.samples[index].payload) for index in self.indices(topic)]

    def change(self, topic: Topic, number: int, change: Callable[[Any], object]) -> None:
        """Change one message of a topic."""
        change(message := self.messages(topic)[number])
        index = self.indices(topic)[number]
        self.samples[index] = self.samples[index]._replace(payload=message.SerializeToString())

    def without(self, *topics: Topic) -> Self:
        """Remove the messages of these topics."""
        self.samples = [one for one in self.samples if not any(topic.matches(one.key) for topic in topics)]
        return self

    def write(
        self,
        path: Path,
        *,
        finish: bool = True,
        config: bool = True,
        toml: str | None = None,
        attached: Calibration | None = None,
        **recording: str,
    ) -> Path:
        """Write the log, finished (with the metadata `recording`) or as left by a recorder that died."""
        content = (Configuration().to_toml() if toml is None else toml).encode()
        attachments = [Attachment("config.toml", "application/toml", content)] if config else []
        if attached is not None:
            attachments.append(Attachment("calibration.fits", "application/fits", calibration_file.to_bytes(attached)))
        log = LogWriter(path, START * 10**9, METADATA, attachments)
        for number, sample in enumerate(self.samples):
            log.write(sample)
            if not finish and number % 100 == 99:
                log.flush()
        if finish:
            return log.finish({"recording": {"messages": str(len(self.samples)), "messages_lost": "0"} | recording})
        log.flush()
        log.abandon()
        return log.part

    def _publish(self, advanced: tuple[State, Outputs], late_ns: int = 0) -> None:
        """Append the messages of the controller's outputs, and the state of the mirror that follows its command."""
        self._state, outputs = advanced
        for event in outputs.events:
            self.event(event.name, **event.details)
        if outputs.command is not None:
            command = outputs.command
            self._mirror_nm = self._to_modes @ command.actuators_nm.ravel()
            self.put(COMMAND, codec.encode_command(command, 10**9, "lowfc", self._state.input_number), late_ns=late_ns)
            state = wire.MirrorState(
                frame_sequence=command.frame_sequence,
                rows=command.actuators_nm.shape[0],
                columns=command.actuators_nm.shape[1],
                actuators=command.actuators_nm.tobytes(),
                command_nm=command.command_nm,
            )
            self.put(MIRROR_STATE, state, late_ns=late_ns + 200_000)
        if outputs.step is not None:
            self.put(STEP, codec.encode_step(outputs.step, self._state.input_number), late_ns=late_ns)
            columns = {"transport_ns": 90_000, "wakeup_ns": 10_000, "compute_ns": late_ns // 2, "publish_ns": 20_000}
            timing = wire.ControlTiming(
                frame_sequence=[outputs.step.frame_sequence],
                frame_to_command_ns=[late_ns],
                **{name: [value] for name, value in columns.items()},
            )
            self.put(TIMING, timing, late_ns=late_ns)
        if outputs.changed or self._frames % 100 == 0:
            state_now = controller_state(self._state, self.settings, self.now_ns)
            self.put(CONTROLLER_STATE, state_now, late_ns=late_ns)

    def _pixels(self, residual_nm: Single, flux_dn: float) -> Pixels:
        """Pixels (rows, columns) of a residual (modes,), with photon and read noise."""
        electrons = self._rng.poisson(TOY.pixels(residual_nm, flux_dn) - self._dark_dn)
        drawn = self._dark_dn + electrons + READ_NOISE_E * self._rng.standard_normal(SHAPE)
        return np.asarray(np.rint(np.clip(drawn, 0, 65_535)), np.uint16)
