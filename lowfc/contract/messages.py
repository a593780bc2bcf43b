"""The table of topics, from which bus, recorder, health, documentation and access control derive.

A topic's key on the bus is its topic in a log without the leading slash. Payloads are protobuf: the project's own
package `lowfc.v1` (declared in `proto/lowfc/v1/lowfc.proto`) and Foxglove's schemas for images and log lines.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from lowfc.arrays import Pixels, Single
from lowfc.contract.errors import BadMessageError
from lowfc.contract.wire import lowfc_pb2 as wire

__all__ = ["TOPICS", "Log", "Message", "RawImage", "Role", "Timestamp", "Topic", "from_timestamp", "timestamp", "wire"]


class Role(StrEnum):
    """Roles of the processes of a run; a mirror's process is named `mirror-<name>`."""

    CAMERA = "camera"
    MIRROR = "mirror"
    CONTROLLER = "controller"
    RECORDER = "recorder"
    LAUNCHER = "launcher"
    VIEWER = "viewer"
    OPERATOR = "operator"
    REPLAY = "replay"
    BENCH = "bench"


EVERYBODY = frozenset(Role)
_OUTSIDE_LOOP = frozenset({Role.RECORDER, Role.VIEWER})
_CAMERA, _MIRROR, _CONTROLLER = frozenset({Role.CAMERA}), frozenset({Role.MIRROR}), frozenset({Role.CONTROLLER})


class Rate(StrEnum):
    """Rate of a topic that is not published at a fixed frequency."""

    LOOP = "every frame"
    EVENT = "on event"


@dataclass(frozen=True, slots=True, eq=False)  # hashed by identity, as it is looked up for every message
class Topic:
    """A topic of the table.

    Attributes:
        key: zenoh key; `{name}` stands for the name of a mirror, a process or a bench value.
        message: class of the payload.
        rate: every frame, on event, or a number of hertz.
        publishers: roles that may publish it; a router drops messages of other roles.
        subscribers: roles that receive it.
        deterministic: in lockstep, two runs with the same seed publish the same payload bytes.
        queryable: a process that joins late can query the publisher for the last message.
        latest_only: monitors receive only the newest message, at display rate.
        direct_subscriber: role that receives it over the direct link from a publisher on the same host; None for none.
        multiple_publishers: several programs of one host may publish it, so that its direct subscriber also reads the
            bus; a router accepts only the roles in `publishers`.
        optional: a recording may omit it; the other topics do not depend on it.
    """

    key: str
    message: type[Message]
    rate: Rate | float
    publishers: frozenset[Role]
    description: str
    subscribers: frozenset[Role] = _OUTSIDE_LOOP
    deterministic: bool = True
    queryable: bool = False
    latest_only: bool = False
    direct_subscriber: Role | None = None
    multiple_publishers: bool = False
    optional: bool = False

    def at(self, name: str) -> str:
        """Key of this topic for the mirror, process or bench value `name`."""
        return self.key.format(name=name)

    @property
    def in_loop(self) -> bool:
        """Whether it is published every frame by or for the controller; such topics are sent before all others."""
        return self.rate is Rate.LOOP and Role.CONTROLLER in self.publishers | self.subscribers

    def matches(self, key: str) -> bool:
        """Whether `key` is this topic, for any name."""
        before, name, after = self.key.partition("{name}")
        if not name:
            return key == before
        return key.startswith(before) and key.endswith(after) and len(key) > len(before) + len(after)


FRAME = Topic(
    "lowfc/camera/frame",
    RawImage,
    Rate.LOOP,
    _CAMERA,
    "Sensor image, mono16, DN; its time is the end of the exposure.",
    subscribers=_CONTROLLER | _OUTSIDE_LOOP,
    latest_only=True,
    direct_subscriber=Role.CONTROLLER,
    optional=True,
)
CAMERA_STATE = Topic(
    "lowfc/camera/state",
    wire.CameraState,
    2.0,
    _CAMERA,
    "The camera's settings.",
    subscribers=EVERYBODY,
    queryable=True,
)
STEP = Topic("lowfc/control/step", wire.ControlStep, Rate.LOOP, _CONTROLLER, "One step of the control law.")
CONTROL_INPUT = Topic(
    "lowfc/control/input",
    wire.ControlInput,
    Rate.EVENT,
    _CONTROLLER,
    "Inputs of the controller other than frames and requests, with all that it reads from its clock.",
)
TIMING = Topic(
    "lowfc/control/timing",
    wire.ControlTiming,
    10.0,
    _CONTROLLER,
    "Durations of the stages of each step.",
    deterministic=False,
    optional=True,
)
CONTROLLER_STATE = Topic(
    "lowfc/control/state",
    wire.ControllerState,
    1.0,
    _CONTROLLER,
    "The controller's state: at this rate while frames arrive, and after most other inputs. It contains all that the "
    "next command depends on, but only the identities of calibration, law and probe sequence.",
    queryable=True,
)
REQUEST = Topic(
    "lowfc/control/request",
    wire.Request,
    Rate.EVENT,
    _CONTROLLER,
    "A request, of an operator or of the controller itself, and its reply.",
)
COMMAND = Topic(
    "lowfc/mirror/{name}/command",
    wire.MirrorCommand,
    Rate.LOOP,
    _CONTROLLER,
    "The commanded shape of the mirror.",
    subscribers=_MIRROR | {Role.RECORDER},
    direct_subscriber=Role.MIRROR,
    multiple_publishers=True,
)
MIRROR_STATE = Topic(
    "lowfc/mirror/{name}/state",
    wire.MirrorState,
    Rate.LOOP,
    _MIRROR,
    "The shape of the mirror.",
    subscribers=_CONTROLLER | _CAMERA | _OUTSIDE_LOOP,
    latest_only=True,
    optional=True,
)
SURFACE = Topic(
    "lowfc/mirror/{name}/surface",
    RawImage,
    30.0,
    _MIRROR,
    "The mirror's surface over the pupil, 32FC1, nm; for display only.",
    latest_only=True,
    optional=True,
)
TRUTH = Topic("lowfc/sim/truth", wire.Truth, Rate.LOOP, _CAMERA, "The true wavefront of the simulation.", optional=True)
OFFLOAD = Topic(
    "lowfc/control/offload",
    wire.ModalOffload,
    1.0,
    _CONTROLLER,
    "Mean modal command, for another adaptive-optics system to take over.",
)
LAW = Topic(
    "lowfc/control/law",
    wire.LinearLaw,
    Rate.EVENT,
    _CONTROLLER,
    "A requested control law, with its matrices; the controller's states name the one in use by its identity.",
    queryable=True,
)
PLAY = Topic(
    "lowfc/control/play",
    wire.Play,
    Rate.EVENT,
    _CONTROLLER,
    "Table of a requested probe sequence; the controller's states name the current one by its identity.",
    queryable=True,
)
CALIBRATION = Topic(
    "lowfc/calibration",
    wire.Calibration,
    Rate.EVENT,
    _CONTROLLER,
    "A calibration loaded at the start or by request: matrices from a frame to modes, and from modes to actuators; the "
    "controller's states name the one in use by its identity.",
    queryable=True,
)
BENCH = Topic(
    "lowfc/bench/{name}",
    wire.BenchValue,
    Rate.EVENT,
    frozenset({Role.BENCH, Role.OPERATOR}),
    "A value of another device on the bench, for interlocks; the controller subscribes to the configured names.",
    subscribers=_CONTROLLER | _OUTSIDE_LOOP,
    deterministic=False,
    queryable=True,
)
EVENT = Topic(
    "lowfc/event",
    Log,
    Rate.EVENT,
    EVERYBODY,
    "An event of the table of events.",
    subscribers=EVERYBODY,
    deterministic=False,
)
HEALTH = Topic(
    "lowfc/health/{name}",
    wire.Health,
    2.0,
    EVERYBODY,
    "Health of a process.",
    subscribers=EVERYBODY,
    deterministic=False,
    queryable=True,
)

TOPICS: tuple[Topic, ...] = (
    FRAME,
    CAMERA_STATE,
    STEP,
    CONTROL_INPUT,
    TIMING,
    CONTROLLER_STATE,
    REQUEST,
    LAW,
    PLAY,
    OFFLOAD,
    COMMAND,
    MIRROR_STATE,
    SURFACE,
    TRUTH,
    CALIBRATION,
    BENCH,
    EVENT,
    HEALTH,
)

REQUEST_KEY = "lowfc/request/{name}"
"""Key of the queryable for a kind of request; the payload of a query is a `lowfc.v1.Request`."""

RECORD_KEY = "lowfc/record/{name}"
"""Key of the recorder's queryables: start and stop."""

MONO16 = "mono16"
FLOAT32 = "32FC1"

_MAX_KEY_LENGTH = 200


@lru_cache(maxsize=256)
def topic_of(key: str) -> Topic:
    """Topic of a key on the bus; KeyError if there is none."""
    if len(key) > _MAX_KEY_LENGTH:
        raise KeyError(key)
    for topic in TOPICS:
        if topic.matches(key):
            return topic
    raise KeyError(key)


@lru_cache(maxsize=256)
def known_topic(key: str) -> Topic | None:
    """Topic of a key on the bus; None if there is none, as for a key of another version or tool."""
    try:
        return topic_of(key)
    except KeyError:
        return None


def timestamp(time_ns: int) -> Timestamp:
    """Message form of nanoseconds since the epoch."""
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def from_timestamp(stamp: Timestamp) -> int:
    """Nanoseconds since the epoch of a message's time."""
    return stamp.seconds * 1_000_000_000 + stamp.nanos


LATEST_NS = 1 << 62
"""Latest valid time of a message, in the year 2116."""
SEQUENCE_BOUND = (1 << 64) - (1 << 33)
"""Valid sequences are below this, so that neither start nor count can overflow; starts go up to the year 2106."""


def checked_time_ns(stamp: Timestamp) -> int:
    """Time of a received message, nanoseconds since the epoch; BadMessageError if it is out of range."""
    time_ns = from_timestamp(stamp)
    if not 0 <= time_ns <= LATEST_NS:
        raise BadMessageError(f"its time is {time_ns} ns since the epoch, not 0 to 2^62")
    return time_ns


def checked_sequence(sequence: int) -> int:
    """A received frame sequence; BadMessageError if it is out of range."""
    if not 0 <= sequence < SEQUENCE_BOUND:
        raise BadMessageError(f"its frame sequence is {sequence}, not below {SEQUENCE_BOUND}")
    return sequence


_FLOAT = np.dtype("<f4")


def floats(data: bytes, *shape: int) -> Single:
    """Array of this shape from a message's little-endian float32; ValueError if the number of values differs."""
    return np.frombuffer(data, _FLOAT).reshape(shape)


def fields_of(source: object, names: Iterable[str]) -> dict[str, Any]:
    """Attributes `names` of `source`, a value or its message, which use the same names."""
    return {name: getattr(source, name) for name in names}


def image(array: Pixels | Single, time_ns: int, frame_id: str) -> RawImage:
    """Message of an image (rows, columns): uint16 becomes mono16, float32 becomes 32FC1, both little-endian."""
    rows, columns = array.shape
    return RawImage(
        timestamp=timestamp(time_ns),
        frame_id=frame_id,
        width=columns,
        height=rows,
        encoding=MONO16 if array.dtype == np.uint16 else FLOAT32,
        step=columns * array.itemsize,
        data=array.tobytes(),
    )
