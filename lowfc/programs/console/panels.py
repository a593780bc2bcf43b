"""The parts of the screen as lines of text, from a reading."""

import re
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from rich.style import Style
from rich.text import Text

from lowfc.arrays import Array
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.envelope import count_of
from lowfc.contract.events import Level as Severity
from lowfc.contract.messages import Log, from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.loop.wording import hertz
from lowfc.programs.console.feed import TREND_S, Reading
from lowfc.programs.console.phrases import phrased
from lowfc.programs.view.draw.colours import GREY, ORANGE, RED, YELLOW, Colour, Rgb, diverging, sequential
from lowfc.programs.view.verdicts.run_state import Liveness
from lowfc.programs.view.verdicts.tile import FILL, INK, WORD, Level, clock, duration, numbers, rounded
from lowfc.programs.view.verdicts.watcher import SILENT_S

_PIXELS = 12
"""Rows and columns of a picture; two rows share a line of text."""
_MODE_LINES = 7  # modes in one column
_SPARKS = "▁▂▃▄▅▆▇█"
_NEAR_LIMIT = 0.95  # fraction of the modal limit from which a command is drawn in red
_GAINS = re.compile(r", gain .*?(?=, leak|;)")
"""Part of the law's text that the knobs already show."""


@lru_cache(maxsize=4096)
def style(ink: Colour | None = None, background: Colour | None = None, *, bold: bool = False) -> Style:
    """Style of a text with these colours; None means the terminal's own."""
    red_green_blue = [None if one is None else "#{:02x}{:02x}{:02x}".format(*one) for one in (ink, background)]
    return Style(color=red_green_blue[0], bgcolor=red_green_blue[1], bold=bold or None)


DIM, WARNED, WRONG, BOLD = style(GREY), style(YELLOW), style(RED, bold=True), style(bold=True)


def verdict(reading: Reading, run: str) -> tuple[Level, str]:
    """Level and text of the verdict, or of a lost connection."""
    if reading.silent_s is None:
        return Level.WARNING, f"NOT CONNECTED  no message of run {run} yet"
    if not reading.connected and reading.state.controller.life is Liveness.STOPPED:
        return Level.NEUTRAL, f"NOT CONNECTED  the processes of run {run} were stopped on request: values are hidden"
    if not reading.connected:
        return Level.BAD, (
            f"NOT CONNECTED  no message of run {run} for {duration(reading.silent_s)}: values are hidden. The run was "
            "killed, or this console is disconnected; a running loop goes on by itself."
        )
    return reading.verdict.level, f"{WORD[reading.verdict.level]}  {phrased(reading.verdict.headline)}".strip()


def tiles(reading: Reading) -> list[Text]:
    """A line for each tile: title, word or number, and explanation."""
    lines = []
    for tile in reading.verdict.tiles:
        line = Text.assemble((f"{tile.title:10}", DIM), f"{WORD[tile.level]:5} ")
        line.append(f" {tile.value:^12} ", style(INK[tile.level], FILL[tile.level], bold=tile.level > Level.GOOD))
        line.append(f" {phrased(tile.detail)}", style())
        lines.append(line)
    return lines


def pictures(reading: Reading) -> list[Text]:
    """The newest frame and the mirror's surface, as small pictures with captions."""
    lines = [Text() for _ in range(_PIXELS // 2)]
    captions = []
    mirror = reading.state.mirror_state
    for array, signed in ((reading.frame, False), (actuators(mirror) if mirror is not None else None, True)):
        if array is None:
            drawn, caption = np.zeros((_PIXELS, _PIXELS, 3), np.uint8), "none yet"
        else:
            small = reduced(array.astype(np.float64))
            largest, lowest = float(np.abs(array).max()), 0.0 if signed else float(small.min())
            shares = (small - lowest) / max(float(np.abs(small - lowest).max()), 1e-9)
            drawn = diverging(shares) if signed else sequential(shares)
            caption = f"mirror ±{largest:.0f} nm" if signed else f"frame to {largest:.0f} DN"
        for line, text in zip(lines, half_block_lines(drawn), strict=True):
            line.append_text(text).append("      ")
        captions.append(f"{caption:18}")
    return [*lines, Text("".join(captions), DIM)]


def reduced(array: Array) -> Array:
    """Means of an image over `_PIXELS` x `_PIXELS` parts."""
    for axis in (0, 1):
        edges = np.linspace(0, array.shape[axis], _PIXELS + 1).astype(int)[:-1]
        sizes = np.diff([*edges, array.shape[axis]])
        sums = np.add.reduceat(array, edges, axis=axis)  # with fewer pixels than parts, some pixels are repeated
        array = sums / np.maximum(sizes, 1).reshape((-1, 1) if axis == 0 else (1, -1))
    return array


def half_block_lines(colours: Rgb) -> list[Text]:
    """Lines of text in which each cell shows two pixels of an image (rows, columns, 3), one above the other."""
    lines = []
    for upper, lower in zip(colours[0::2].tolist(), colours[1::2].tolist(), strict=True):
        line = Text()
        for above, below in zip(upper, lower, strict=True):
            line.append("▀", style(tuple(above), tuple(below)))
        lines.append(line)
    return lines


def sparks(reading: Reading) -> list[Text]:
    """Sparklines of the residual and the flux, each with its last value."""
    wavefront, flux = reading.state.wavefront, reading.light[-1] if reading.light else float("nan")
    kind = "true" if reading.state.true else "measured"
    residual = "?" if wavefront is None else f"{rounded(wavefront.residual_nm)} nm {kind}"
    light = "?" if np.isnan(flux) else f"{100 * flux:.0f} %"
    rows = ("residual", reading.residual_nm, residual), ("light", reading.light, light)
    return [
        Text.assemble((f"{name:10}", DIM), (f"{sparkline(values):>{TREND_S}}", style(ORANGE)), f" {last}")
        for name, values, last in rows
    ]


def sparkline(values: Sequence[float]) -> str:
    """Values as bars from zero to the largest; a negative value has the lowest bar, NaN a space."""
    bounded = np.minimum(values, np.finfo(float).max)  # infinity / infinity is NaN
    largest = max(np.nanmax(bounded, initial=0.0), 1e-9)
    return "".join(" " if np.isnan(one) else _SPARKS[min(int(max(one, 0.0) / largest * 8), 7)] for one in bounded)


def modes(reading: Reading, width: int) -> list[Text]:
    """The command of each mode as a bar between its limits; the modes fill one column after the other."""
    state, noll = reading.state.snapshot.controller, reading.state.snapshot.noll
    if state is None or not noll or len(noll) != len(reading.command_nm):
        return [Text("no calibration, so no modes yet", DIM)]
    columns = -(-len(noll) // _MODE_LINES)
    cell_width = width // columns
    cells = [
        _mode(mode, float(command), float(limit), cell_width - 2)  # without the bar's centre and the space after it
        for mode, command, limit in zip(noll, reading.command_nm, state.limit_nm, strict=False)
    ]
    lines = []
    for number in range(min(_MODE_LINES, len(cells))):
        line = Text()
        for cell in cells[number::_MODE_LINES]:
            line.append_text(cell).append(" ")
        lines.append(line)
    return lines


def _mode(noll: int, command_nm: float, limit_nm: float, width: int) -> Text:
    numbers_text = f"{command_nm:+6.1f}/{limit_nm:.0f}" if width >= 22 else ""
    half = max(1, (width - 4 - 11 * bool(numbers_text)) // 2)
    share = abs(command_nm) / limit_nm if abs(command_nm) < limit_nm else 1.0  # a received NaN fills the bar
    bar = "█" * round(share * half)
    left, right = (f"{bar:>{half}}", " " * half) if command_nm < 0 else (" " * half, f"{bar:{half}}")
    ink = WRONG if share >= _NEAR_LIMIT else style(ORANGE)
    numbers_column = f"{numbers_text:>11}" if numbers_text else ""
    return Text.assemble((f"Z{noll:<3}", DIM), (left, ink), ("│", DIM), (right, ink), numbers_column)


def facts(reading: Reading) -> Text:
    """Settings: law, offset and channels, lease or last note."""
    by_title, state = reading.verdict.facts, reading.state.snapshot.controller
    law = _GAINS.sub("", by_title["CONTROL LAW"])
    rows = {"law": law, "shapes": by_title["OFFSET AND CHANNELS"], "note": by_title["LAST NOTE"]}
    if state is not None and state.lease.id and not state.lease.ended:
        rows["note"] = f"reserved for {printable(state.lease.holder)}"
    return Text("\n").join(Text.assemble((f"{name:7}", DIM), value) for name, value in rows.items())


def peers(reading: Reading, run: str) -> Text:
    """Processes, the silent ones in red, and the frame rate."""
    line = Text(f"run {run} ", DIM)
    snapshot = reading.state.snapshot
    for name, last in sorted(snapshot.health.items()):
        silent_s, stopped = (snapshot.host_ns - last.time_ns) * 1e-9, last.health.state in ("stopping", "stopped")
        if silent_s > SILENT_S and not stopped:
            line.append(f" {name} silent {duration(silent_s)} ", WRONG)
        else:
            line.append(f" {name} {'stopped' if stopped else 'alive'} ", DIM if stopped else style())
    rate_hz, camera = reading.state.rate_hz, reading.state.camera.life
    if rate_hz is not None and camera is Liveness.RUNNING and reading.connected:
        line.append(f" {hertz(rate_hz)}", BOLD)
    return line


def event_line(event: Log, times: int = 1) -> Text:
    """An event and its count."""
    ink = WRONG if event.level >= Severity.ERROR else WARNED if event.level >= Severity.WARNING else style()
    message = printable(event.message)
    return Text.assemble(
        (f"{clock(from_timestamp(event.timestamp))} ", DIM),
        (f"{times} x " if times > 1 else "", BOLD),
        (f"{printable(event.name)}: ", DIM),
        (message if message.startswith("NOTE ") else phrased(message), ink),  # a note stays as written
    )


def request_line(request: wire.Request) -> Text:
    """A request with requester, answer, and the first frame for which it is in force."""
    fields = [numbers(list(request.values)), printable(request.text)]
    if request.modes:
        fields.append(f"modes {','.join(map(str, request.modes))}")
    reply = phrased(printable(request.reply))
    return Text.assemble(
        (f"{clock(from_timestamp(request.timestamp))} ", DIM),
        (" ".join(filter(None, [printable(request.name), *fields])), BOLD),
        (f" ({printable(request.requester) or 'unknown requester'}): ", DIM),
        (f"{reply}, from frame {count_of(request.frame_sequence)} on", style())
        if request.accepted
        else (f"refused: {reply}", WRONG),
    )
