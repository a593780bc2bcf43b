"""Control characters in notes and other text of unknown origin are escaped and never sent to a terminal."""

import errno
import sys
from pathlib import Path

import pytest

from lowfc.adapters.process.terminal import new_app, run_app
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError, RequestRefusedError
from lowfc.contract.messages import EVENT, REQUEST, Log, wire
from lowfc.contract.printable import LINES, printable
from lowfc.programs.cli.output import print_result
from lowfc.programs.view.panels.loop import LOG
from lowfc.programs.view.recorded import draw_logs
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from tests.support import report_log
from tests.support.loops import lowfc
from tests.support.report_log import SyntheticLog
from tests.support.stage import Tape

HOSTILE = "clouds\x1b[2J\x07 \x9b31mred \u202egnorts \u2028 caf\u00e9 5\u2009nm\r\nerror: fine"
ESCAPED = r"clouds\x1b[2J\x07 \x9b31mred \u202egnorts \u2028 café 5" + "\u2009" + r"nm\r\nerror: fine"


def assert_escaped(output: str, *, keep: str = "\n") -> None:
    """Assert that the output contains the hostile text, but none of its control characters."""
    assert printable(output, keep) == output
    assert "clouds\\x1b[2J" in output


def test_only_control_characters_are_escaped() -> None:
    assert printable(HOSTILE) == ESCAPED
    assert printable(HOSTILE, LINES) == ESCAPED.replace("\\n", "\n")
    harmless = "R = 3 µm, \u00a0 ±2 \\n 日本 🔭 \u2009"
    assert printable(harmless) == harmless
    assert printable("a\udc80b") == r"a\udc80b"


def test_a_process_escapes_its_events(capsys: pytest.CaptureFixture[str]) -> None:
    Listener(FakeClock()).service("camera").event("RECORDING_FAILED", why=HOSTILE)
    assert capsys.readouterr().err == f"camera: RECORDING_FAILED recording stopped: {ESCAPED}\n"


@pytest.mark.usefixtures("restored_signals")
@pytest.mark.parametrize("fault", [RequestRefusedError(HOSTILE), OSError(errno.ENAMETOOLONG, "too long", HOSTILE)])
def test_a_command_escapes_its_output_and_errors(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    print_result({}, f"{HOSTILE}\nframe 3", as_json=False)
    assert_escaped(capsys.readouterr().out)
    failing = new_app("")

    @failing.command()
    def fail() -> None:
        raise fault

    monkeypatch.setattr(sys, "argv", ["lowfc"])
    with pytest.raises(SystemExit):
        run_app(failing)
    assert_escaped(capsys.readouterr().err)


def test_configuration_errors_are_escaped() -> None:
    with pytest.raises(ConfigurationError) as caught:
        load(None, {"mirror.stuck_nm": {HOSTILE: "high"}})
    assert_escaped(str(caught.value))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log whose recorder did not escape anything."""
    night = SyntheticLog().frames(200)
    night.put(EVENT, Log(level=3, name=HOSTILE, message=HOSTILE))  # type: ignore[arg-type]
    night.put(EVENT, Log(level=2, name="controller", message=f"MODE_CHANGED loop open -> closed: {HOSTILE}"))  # type: ignore[arg-type]
    night.put(REQUEST, wire.Request(name=HOSTILE, accepted=True, reply=HOSTILE))
    night.frames(50)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(report_log, "METADATA", {"lowfc": {"host": HOSTILE, "numpy": HOSTILE}})
        return night.write(tmp_path_factory.mktemp("night") / "night.mcap")


@pytest.mark.usefixtures("without_drawings")
@pytest.mark.parametrize("command", ["info", "report", "replay"])
def test_readers_of_a_log_escape_their_output(log: Path, command: str) -> None:
    done = lowfc(command, log)
    assert done.exit_code == 0, done.output
    assert_escaped(done.output)
    if command == "report":
        page = log.with_suffix(".html").read_text()
        assert_escaped(page, keep=LINES)
        assert page.count("clouds\\x1b[2J") >= 6, "in events, requests and versions"


def test_a_view_escapes_events(log: Path) -> None:
    tape = Tape()
    draw_logs([log], None, tape)  # type: ignore[arg-type]
    paths = [path for path in tape.paths if path.startswith(LOG)]
    assert any("clouds" in path for path in paths)
    texts = [text for path in paths for text in tape.last(path).text.as_arrow_array().to_pylist()]
    assert sum("clouds" in text for text in texts) == 2
    for text in (*paths, *texts):
        assert printable(text) == text
