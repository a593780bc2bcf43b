"""What is asked of a what-if on the command line, and a controller of one's own: mistakes are made plain."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lowfc.contract.errors import ConfigurationError
from lowfc.programs.logs.what_if.compare import WhatIf, wanted
from lowfc.programs.logs.what_if.options import user_controller


@pytest.fixture
def controller(tmp_path: Path) -> Callable[[str], str]:
    """Writes a file with a controller, and returns where it is."""

    def write(body: str) -> str:
        path = tmp_path / "mine.py"
        path.write_text(body)
        return f"{path}:step"

    return write


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("def step(state, error_nm):\n    return error_nm[0]\n", r"call 1: TypeError: .* must return"),
        ("def step(state, error_nm):\n    return state, error_nm[:1]\n", r"must be 3 finite numbers, got shape \(1,\)"),
        ("def step(state, error_nm):\n    return state, error_nm / 0\n", "call 1: .*divide by zero|finite numbers"),
        ("def step(state, error_nm):\n    return state, ['a'] * 3\n", "call 1: ValueError"),
        ("def stop(state, error_nm):\n    pass\n", r"has no function 'step' \(did you mean 'stop'\?\)"),
        ("def step(:\n", "cannot be run: SyntaxError"),
        ("import no_such_module_at_all\n", "cannot be run: ModuleNotFoundError"),
        ("raise SystemExit(0)\n", "cannot be run: SystemExit: 0"),
        ("def step(state, error_nm):\n    exit(3)\n", "call 1: SystemExit: 3"),
    ],
)
def test_a_controllers_mistakes_are_made_plain(controller: Callable[[str], str], body: str, message: str) -> None:
    def call() -> None:
        user_controller(controller(body))(None, np.ones(3, np.float32), np.ones(3, np.float32))

    with pytest.raises(ConfigurationError, match=message):
        call()


def test_what_a_controller_prints_is_not_among_the_figures(
    controller: Callable[[str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    where = controller("print('loaded')\ndef step(state, error_nm):\n    print('called')\n    return state, error_nm\n")
    user_controller(where)(None, np.ones(3, np.float32), np.ones(3, np.float32))
    assert capsys.readouterr() == ("", "loaded\ncalled\n")


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("mine.py", "must be FILE.py:NAME"),
        ("mine.txt:step", "must be FILE.py:NAME"),
        ("nowhere.py:step", "there is no file nowhere.py"),
    ],
)
def test_where_a_controller_is_must_be_said(where: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        user_controller(where)


def test_the_words_of_the_command_line() -> None:
    asked = wanted(" gain=0.6, leak=0.01,tilt_limit_nm=80,estimator=pinv", controller=None)
    assert asked == WhatIf({"gain": 0.6, "leak": 0.01, "tilt_limit_nm": 80.0}, "pinv")
    assert wanted("", controller="mine.py:step") == WhatIf(controller="mine.py:step")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gian=0.6", r"unknown key 'gian' \(did you mean 'gain'\?\); known are gain, leak,"),
        ("tilt_gains=1", r"did you mean 'tilt_gain'"),
        ("gain", "gain needs a value"),
        ("gain=", "gain needs a value"),
        ("gain=high", "gain must be a number, got 'high'"),
        ("gain=1,gain=2", "gain is there twice"),
        ("", "a what-if changes something; give --set KEY=VALUE"),
        ("estimator=best", "estimator must be weighted or pinv, got 'best'"),
    ],
)
def test_words_that_make_no_sense_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        wanted(text)
    with pytest.raises(ConfigurationError, match="gain are the integrator's"):
        wanted("gain=0.3", controller="mine.py:step")
