"""Write the tables of docs/hardware.md: `python docs/make_hardware.py`; a test holds that they are these.

They come from the table of topics, the messages' declaration and the keys of the configuration.
"""

from importlib.resources import files
from pathlib import Path

from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

from lowfc.contract.configuration import Mirror, keys
from lowfc.contract.messages import CAMERA_STATE, COMMAND, EVENT, FRAME, HEALTH, MIRROR_STATE, SURFACE, Role, Topic
from lowfc.programs.conformance.agreement import AGREEMENTS

DOCUMENT = Path(__file__).parent / "hardware.md"
TABLES = ("camera topics", "mirror topics", "CameraState", "MirrorCommand", "MirrorState", "mirror keys", "agreement")

_MESSAGES = 4  # numbers of the fields of the descriptors, which the places of comments are made of
_FIELDS = 2
_EVERYBODYS = (EVENT, HEALTH)


def marks(table: str) -> tuple[str, str]:
    """What stands before and after a table in the document."""
    return f"<!-- {table}: begin -->\n", f"<!-- {table}: end -->"


def render(table: str) -> str:
    """A table in Markdown.

    Raises:
        ValueError: there is no such table.
    """
    match table:
        case "camera topics":
            rows = topics(Role.CAMERA, (FRAME, CAMERA_STATE))
        case "mirror topics":
            rows = topics(Role.MIRROR, (COMMAND, MIRROR_STATE, SURFACE))
        case "mirror keys":
            rows = [["key", "default", ""]]
            for name, info in keys(Mirror, "mirror.").items():
                default = info.get_default(call_default_factory=True)
                rows.append([f"`{name}`", f"`{default!r}`", sentence(info.description or "")])
        case "agreement":
            rows = [["the camera's", "the configuration's", "may differ by", "needed", "used for"]]
            for one in AGREEMENTS:
                needed, apart = "yes" if one.needed else "no", f"{one.apart:.0%}" if one.apart else "nothing"
                rows.append([f"`{one.field}`", f"`{one.key}`", apart, needed, one.use])
        case "CameraState" | "MirrorCommand" | "MirrorState":
            rows = fields(table)
        case _:
            raise ValueError(f"there is no table {table!r}")
    head, *body = (f"| {' | '.join(row)} |\n" for row in rows)
    return f"{head}{'|---' * len(rows[0])}|\n{''.join(body)}"


def topics(role: Role, own: tuple[Topic, ...]) -> list[list[str]]:
    """What a role publishes and subscribes."""
    rows = [["topic", "message", "when", "you", ""]]
    for topic in (*own, *_EVERYBODYS):
        when = f"{topic.rate:g} Hz" if isinstance(topic.rate, float) else str(topic.rate)
        does = "publish" if role in topic.publisher else "subscribe"
        answers = "; answer who asks for the last" if topic.queryable else ""
        name = topic.message.DESCRIPTOR.full_name
        rows.append([f"`{topic.key}`", f"`{name}`", when, does, topic.sentence.rstrip(".") + answers])
    return rows


def fields(message: str) -> list[list[str]]:
    """Number, type and sentence of every field of one of our messages."""
    file = declaration()
    comments = {
        tuple(location.path): sentence(location.leading_comments) for location in file.source_code_info.location
    }
    index = [one.name for one in file.message_type].index(message)
    rows = [["field", "type", "number", ""]]
    for place, field in enumerate(file.message_type[index].field):
        kind = field.type_name.rpartition(".")[2] or type(field).Type.Name(field.type).removeprefix("TYPE_").lower()
        many = "repeated " if field.label == type(field).LABEL_REPEATED else ""
        comment = comments.get((_MESSAGES, index, _FIELDS, place)) or "When that was which it tells"
        rows.append([f"`{field.name}`", many + kind, str(field.number), comment])
    return rows


def declaration() -> FileDescriptorProto:
    """The messages' declaration, with its comments."""
    every = FileDescriptorSet.FromString((files("lowfc.contract.wire") / "lowfc.desc").read_bytes())
    return next(file for file in every.file if file.package == "lowfc.v1")


def sentence(text: str) -> str:
    """On one line, without the full stop."""
    return " ".join(text.split()).removesuffix(".")


def main() -> None:
    """All of them, into the document."""
    text = DOCUMENT.read_text()
    for table in TABLES:
        begin, end = marks(table)
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}{render(table)}{end}{rest.partition(end)[2]}"
    DOCUMENT.write_text(text)


if __name__ == "__main__":
    main()
