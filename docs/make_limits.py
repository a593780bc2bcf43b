"""Write the tables of what the code decides into the documents: `python docs/make_limits.py`; a test holds them.

They come from the constants that the commands go by, and from the keys of the configuration.
"""

from pathlib import Path

from make_hardware import marks, sentence

from lowfc.client import stream
from lowfc.contract.codec import MOST_BYTES
from lowfc.contract.configuration import Acceptance, keys
from lowfc.control import linearity, transfer_function
from lowfc.control.stability import LEAST_GAIN_MARGIN, LEAST_PHASE_MARGIN_DEG, LOWEST_GAIN
from lowfc.control.state import FADING_FRAMES, SETTLING_FRAMES
from lowfc.control.vibration import FEWEST
from lowfc.programs.acceptance import capture as acceptance_capture
from lowfc.programs.acceptance import linearity as acceptance_linearity
from lowfc.programs.acceptance import rejection as acceptance_rejection
from lowfc.programs.tune.figures import OPTICAL_GAIN_MAS

FOLDER = Path(__file__).parent
TABLES = (("tuning", "limits"), ("acceptance", "requirements"), ("acceptance", "limits"), ("operating", "limits"))
"""Names of the documents, and of a table in each."""

TAKEOVER = (
    ("frames for which a new law follows before it drives", f"{SETTLING_FRAMES}"),
    ("frames in which it then takes over", f"{FADING_FRAMES}"),
)
LIMITS = {
    "tuning": (
        ("frames in a row that a law is tuned from, at least", f"{FEWEST}"),
        ("tilt of an open loop above which it is flagged, mas rms per axis", f"{OPTICAL_GAIN_MAS:g}"),
        ("gain margin of an integrator, at least", f"{LEAST_GAIN_MARGIN:g}"),
        ("phase margin of an integrator, at least, deg", f"{LEAST_PHASE_MARGIN_DEG:g}"),
        ("integrator gain, at least", f"{LOWEST_GAIN:g}"),
        *TAKEOVER,
    ),
    "acceptance": (
        (
            "rejection: standard errors that must fit into the tolerance, for a line to be judged",
            f"{transfer_function.SURE:g}",
        ),
        (
            "rejection: part of a mode's lines that must be judged for its rejection",
            f"{acceptance_rejection.LEAST_JUDGED:g}",
        ),
        (
            "linearity: amplitudes, times `linear_nm`",
            ", ".join(f"{size:g}" for size in acceptance_linearity.AMPLITUDES),
        ),
        ("linearity: standard errors beyond the limit at which a value is beyond it", f"{linearity.SURE:g}"),
        (
            "capture-range: sizes, times what is required",
            ", ".join(f"{size:g}" for size in acceptance_capture.SIZES),
        ),
        ("capture-range: part of a shape that may be left over", f"{linearity.MISSED:g}"),
    ),
    "operating": (
        *TAKEOVER,
        ("frames or steps that wait for a Python program, at most", f"{stream.WAITING}"),
        ("size of a request, at most, MB", f"{MOST_BYTES / 1e6:g}"),
    ),
}


def document(name: str) -> Path:
    """The document of that name."""
    return FOLDER / f"{name}.md"


def render(name: str, table: str) -> str:
    """A table of a document in Markdown."""
    rows: list[tuple[str, ...]]
    if table == "limits":
        rows = [("what", "value"), *LIMITS[name]]
    else:
        rows = [("key", "default", "what must be")]
        for key, info in keys(Acceptance).items():
            rows.append((f"`{key}`", f"{info.default:g}", sentence(info.description or "")))
    head, *body = (f"| {' | '.join(row)} |\n" for row in rows)
    return f"{head}{'|---' * len(rows[0])}|\n{''.join(body)}"


def main() -> None:
    """All of them, into their documents."""
    for name, table in TABLES:
        begin, end = marks(table)
        before, _, rest = document(name).read_text().partition(begin)
        document(name).write_text(f"{before}{begin}{render(name, table)}{end}{rest.partition(end)[2]}")


if __name__ == "__main__":
    main()
