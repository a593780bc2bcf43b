"""Tables from the code: packages, API, topics, messages, requests, events, buttons, thresholds of the commands."""

import ast
import re
from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from importlib.resources import files
from pkgutil import walk_packages
from typing import Any, get_args

from google.protobuf.descriptor_pb2 import FileDescriptorSet

from lowfc.client import stream
from lowfc.client.requests import DECLARED as REQUESTS
from lowfc.contract.codecs.codec import max_bytes
from lowfc.contract.configuration import Acceptance
from lowfc.contract.events import EVENTS, Event, Level
from lowfc.contract.messages import CAMERA_STATE, COMMAND, EVENT, FRAME, HEALTH, MIRROR_STATE, SURFACE, Role, Topic
from lowfc.contract.wire import lowfc_pb2
from lowfc.control.calibration import linearity
from lowfc.control.laws import transfer_function
from lowfc.control.laws.stability import LOWEST_GAIN, MIN_GAIN_MARGIN, MIN_PHASE_MARGIN_DEG
from lowfc.control.laws.vibration import FEWEST
from lowfc.control.loop import guard
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.programs.commissioning.acceptance import capture as acceptance_capture
from lowfc.programs.commissioning.acceptance import linearity as acceptance_linearity
from lowfc.programs.commissioning.acceptance import rejection as acceptance_rejection
from lowfc.programs.commissioning.conformance.settings import AGREEMENTS
from lowfc.programs.commissioning.tune.result import OPTICAL_GAIN_MAS
from lowfc.programs.console.actions import ACTIONS, SAFE
from tools import continuous
from tools.advice import ADVICE, REASONS
from tools.shared import ROOT, markdown

API = ("client", "device", "optics", "design", "control")
"""Packages of the Python API."""
_MESSAGES, _FIELDS = 4, 2  # field numbers of `message_type` and `field`: protoc stores comments under such paths
_UNCOMMENTED = {"timestamp": "Time of the reported quantity; of a command, that of its frame"}
_NEW_LAW = (
    ("frames for which a new law observes", SETTLING_FRAMES),
    ("frames of the cross-fade to a new law", FADING_FRAMES),
)
_TUNING = (
    ("minimum number of consecutive frames for tuning", FEWEST),
    ("tilt of an open loop above which `lowfc tune` warns of a low optical gain, mas rms per axis", OPTICAL_GAIN_MAS),
    ("minimum gain margin of an integrator", MIN_GAIN_MARGIN),
    ("minimum phase margin of an integrator, deg", MIN_PHASE_MARGIN_DEG),
    ("lowest integrator gain that `lowfc tune` chooses", LOWEST_GAIN),
    *_NEW_LAW,
)
_GUARD = (
    ("duration of a block, s, unless the minimum number of frames takes longer", guard.BLOCK_S),
    ("minimum number of frames of a block", guard.MIN_BLOCK_FRAMES),
    ("consecutive blocks with a worse law or an amplifying loop before the integrator takes over", guard.WORSE_BLOCKS),
    ("law is worse if mean squared error / that of the integrator is above", guard.WORSE_RATIO),
    (
        "loop amplifies if mean squared error / long-term mean square of the pseudo-open-loop modes is above",
        guard.AMPLIFIED,
    ),
    ("time constant of the long-term mean square, s", guard.LONG_TERM_S),
    ("duration of a cross-fade, s", guard.CROSS_FADE_S),
    ("law is far better if mean squared error / that of the integrator is below", guard.BETTER_RATIO),
    (
        "time for which the law must be far better before it drives again, s; it doubles with each takeover",
        guard.BETTER_S,
    ),
    ("takeovers by the integrator after which only an operator reactivates the law", guard.MAX_TAKEOVERS),
)
_ACCEPTANCE = (
    (
        "rejection: minimum ratio of tolerance to standard error at which a probed frequency is evaluated",
        transfer_function.SIGMAS,
    ),
    ("rejection: minimum fraction of a mode's probed frequencies that are evaluated", acceptance_rejection.MIN_JUDGED),
    ("linearity: amplitudes, times `linear_nm`", *acceptance_linearity.AMPLITUDES),
    ("linearity: a value fails if it exceeds its limit by more than this number of standard errors", linearity.SIGMAS),
    ("capture-range: amplitudes, times the required one", *acceptance_capture.SIZES),
    ("capture-range: maximum fraction of a shape that remains", linearity.MAX_RESIDUAL),
)
_OPERATING = (
    *_NEW_LAW,
    ("frames or steps queued for a Python program, at most", stream.BUFFERED_MESSAGES),
    ("size of a request, at most, MB", max_bytes("law") / 1e6),
)


def packages() -> str:
    """Packages with the first line of their docstrings."""
    folder = ROOT / "lowfc"
    rows = []
    for path in sorted(folder.rglob("*/__init__.py")):
        text = ast.get_docstring(ast.parse(path.read_text())) or ""
        rows.append((f"`{'.'.join(path.relative_to(ROOT).parent.parts)}`", text.splitlines()[0]))
    return markdown(("package", "holds"), rows)


def exported_names(package: str) -> str:
    """Exported names of a package of the Python API, or its modules, with the first paragraph of their docstrings."""
    root = import_module(package)
    if hasattr(root, "__all__"):
        documented = [(name, _about(getattr(root, name))) for name in root.__all__]
    else:
        documented = [(name, import_module(name).__doc__) for name in modules(package)]
    rows = ((f"`{name}`", one_line((text or "").split("\n\n")[0])) for name, text in documented)
    return markdown(("name", "description"), rows)


def modules(package: str) -> list[str]:
    """Dotted names of the modules of a package and of the packages in it."""
    found = walk_packages(import_module(package).__path__, f"{package}.")
    return [module.name for module in found if not module.ispkg]


def _about(value: Any) -> str | None:
    """Docstring of a class or a function, or the type of an array."""
    types = get_args(value)
    return f"numpy array of {get_args(types[1])[0].__name__}" if types else value.__doc__


def limits(rows: Iterable[tuple[str, *tuple[float, ...]]]) -> str:
    """Table of limits."""
    return markdown(("limit", "value"), ((name, ", ".join(f"{one:g}" for one in values)) for name, *values in rows))


def requirements() -> str:
    """Requirements of an acceptance run."""
    descriptions = Acceptance.descriptions()
    rows = ((f"`{key}`", f"{default:g}", one_line(descriptions[key])) for key, default in Acceptance())
    return markdown(("key", "default", "requirement"), rows)


def agreement() -> str:
    """Camera settings that must agree with the configuration."""
    head = ("camera setting", "configuration key", "tolerance", "needed", "used for")
    rows = []
    for setting in AGREEMENTS:
        needed = "yes" if setting.disturbs_loop else "no"
        tolerance = f"{setting.tolerance:.0%}" if setting.tolerance else "exactly equal"
        rows.append((f"`{setting.field}`", f"`{setting.key}`", tolerance, needed, setting.used_for))
    return markdown(head, rows)


def topics(role: Role, *own: Topic) -> str:
    """Topics that a role publishes and subscribes to."""
    rows = []
    for topic in (*own, EVENT, HEALTH):
        does = "publish" if role in topic.publishers else "subscribe"
        answers = "; the last one is returned on query" if topic.queryable else ""
        name = topic.message.DESCRIPTOR.full_name
        rows.append((f"`{topic.key}`", f"`{name}`", when(topic), does, topic.description.rstrip(".") + answers))
    return markdown(("topic", "message", "when", "your program", "description"), rows)


def when(topic: Topic) -> str:
    """Rate or occasion at which a topic is published."""
    return f"{topic.rate:g} Hz" if isinstance(topic.rate, float) else str(topic.rate)


def fields(message: str) -> str:
    """Number, type and description of every field of one of our messages."""
    descriptors = FileDescriptorSet.FromString((files("lowfc.contract.wire") / "lowfc.desc").read_bytes())
    file = next(file for file in descriptors.file if file.package == "lowfc.v1")
    comments = {
        tuple(location.path): one_line(location.leading_comments) for location in file.source_code_info.location
    }
    index = [one.name for one in file.message_type].index(message)
    rows = []
    for number, field in enumerate(file.message_type[index].field):
        kind = field.type_name.rpartition(".")[2] or type(field).Type.Name(field.type).removeprefix("TYPE_").lower()
        repeated = "repeated " if field.label == type(field).LABEL_REPEATED else ""
        comment = comments.get((_MESSAGES, index, _FIELDS, number)) or _UNCOMMENTED[field.name]
        rows.append((f"`{field.name}`", repeated + kind, field.number, comment))
    return markdown(("field", "type", "number", "description"), rows)


def one_line(text: str | None) -> str:
    """Text on one line without its full stop."""
    return " ".join((text or "").split()).removesuffix(".")


def requests() -> str:
    """Every request."""
    rows = []
    for request in REQUESTS:
        contents = "; ".join(f"`{name}`: {what}" for name, what in request.fields)
        rows.append(
            (f"`{request.key}`", contents, request.description, f"`{request.example}`" if request.example else "")
        )
    return markdown(("query", "fields of the request", "what it does", "`lowfc ctl`"), rows)


def buttons() -> str:
    """The console's buttons."""
    rows = ((f"`{action.key}`", action.name, action.description) for action in (SAFE, *ACTIONS))
    return markdown(("key", "button", "what it does"), rows)


def events(*levels: Level) -> str:
    """Every event of these levels: text, cause, remedy."""
    return "\n".join(_event(event) for event in EVENTS.values() if event.level in levels)


def _event(event: Event) -> str:
    cause, remedy = ADVICE[event.name]
    shown = re.sub(r"\{(\w+)[^}]*\}", r"{\1}", event.description)
    return (
        f"### {event.name}\n\n`{event.level.name} {event.name} {shown.replace('`', '')}`\n\n"
        f"Why: {cause}\n\nWhat to do: {remedy}\n"
    )


def reasons() -> str:
    """Every reason of a refused frame or command, and every limit."""
    names = [one.name.removeprefix("REASON_") for one in lowfc_pb2.Reason.DESCRIPTOR.values[1:]]
    return markdown(("reason", "why", "what to do"), ((f"`{name}`", *REASONS[name]) for name in names))


DECLARED: dict[str, Callable[[], str]] = {
    "requests": requests,
    "buttons": buttons,
    "reasons": reasons,
    "warnings": partial(events, Level.ERROR, Level.WARNING),
    "information": partial(events, Level.INFO),
    "packages": packages,
    "requirements": requirements,
    "continuous": continuous.table,
    "tuning limits": partial(limits, _TUNING),
    "guard limits": partial(limits, _GUARD),
    "acceptance limits": partial(limits, _ACCEPTANCE),
    "operating limits": partial(limits, _OPERATING),
    "camera topics": partial(topics, Role.CAMERA, FRAME, CAMERA_STATE),
    "mirror topics": partial(topics, Role.MIRROR, COMMAND, MIRROR_STATE, SURFACE),
    **{name: partial(fields, name) for name in ("CameraState", "MirrorCommand", "MirrorState")},
    "agreement": agreement,
    **{f"names {one}": partial(exported_names, f"lowfc.{one}") for one in API},
}
"""The tables by their names in the pages."""
