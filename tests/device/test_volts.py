"""Mirrors driven by voltages: conversion from surface to drive values, and the example driver of a vendor's library."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError
from lowfc.device import VoltMap, VoltOptions, plugins

ROOT = Path(__file__).parents[2]
CONFIG = load(None, {"mirror.rows": 2, "mirror.columns": 3, "mirror.nm_per_unit": 1000.0})
SURFACE = np.array([[100, -200, 300], [0, 5000, -5000]], np.float32)


def stored(path: Path, values: Any) -> str:
    np.save(path, np.array(values, float))
    return str(path)


def test_a_surface_is_converted_to_clipped_values_in_channel_order(tmp_path: Path) -> None:
    options = VoltOptions(
        zero_map=stored(tmp_path / "zero.npy", [[0.5, 0.4, 0.5], [0.3, 0.5, 0.5]]),
        gain_map=stored(tmp_path / "gain.npy", [[1, 2, 0], [1, 1, 1]]),  # the third actuator has no channel
        order=stored(tmp_path / "order.npy", [[5, 0, -1], [2, 3, 4]]),
        highest=0.9,
    )
    mirror = VoltMap(options, CONFIG, channels=8)
    values = mirror.values(SURFACE)
    np.testing.assert_allclose(values, [0.3, 0, 0.3, 0.9, 0, 0.6, 0, 0], atol=1e-7)
    reached = mirror.surface_nm(values)
    np.testing.assert_allclose(reached, [[100, -200, 0], [0, 400, -500]], atol=1e-3)
    assert reached.dtype == np.float32
    assert VoltMap(options, CONFIG).channels == 6


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("order", [[0, 0, 1], [2, 3, 4]], "its own channel"),
        ("order", [[0, 9, 1], [2, -1, 4]], "below 8, or -1 if it has none; got 0 to 9 for 5 actuators"),
        ("order", [[0, 1, 2], [3, 4, 5.5]], "whole number"),
        ("order", [[0, 1, 2], [3, 4, 1e30]], "whole number"),
        ("order", [[-1, -1, -1], [-1, -1, -1]], "no actuator has a channel"),
        ("gain_map", [[0, 1, 1], [1, 1, 1]], "above 0"),
        ("zero_map", [[2, 0, 0], [0, 0, 0]], "values at 0 nm"),
        ("zero_map", [[0, 0, 0]], "1 x 3 values"),
    ],
)
def test_invalid_maps_are_refused(tmp_path: Path, name: str, values: Any, why: str) -> None:
    options = VoltOptions(**{name: stored(tmp_path / "map.npy", values)})
    with pytest.raises(ConfigurationError, match=why):
        VoltMap(options, CONFIG, channels=8)


def test_without_an_order_the_message_says_how_the_channels_are_numbered() -> None:
    with pytest.raises(ConfigurationError, match=r"order \(none: row by row\).*below 5.*got 0 to 5 for 6 actuators"):
        VoltMap(VoltOptions(), CONFIG, channels=5)


class BmcDm:
    """Stand-in for the vendor's class: records the values, and fails once `broken` is set."""

    def open_dm(self, serial: str) -> int:
        return 0 if serial == "17CW000#001" else 5

    def num_actuators(self) -> int:
        return 8

    def send_data(self, values: Any) -> int:
        self.sent = values
        return 7 if getattr(self, "broken", False) else 0

    def error_string(self, status: int) -> str:
        return f"error {status}"

    def close_dm(self) -> int:
        self.closed = True
        return 0


def test_the_boston_mirror_example_sends_values_and_raises_the_vendors_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bmc", SimpleNamespace(BmcDm=BmcDm, NO_ERR=0))
    monkeypatch.setattr(sys, "path", list(sys.path))
    name = f"{ROOT}/examples/boston_mirror.py:BostonMirror"

    def opened(serial: str) -> Any:
        return plugins.opened("mirror", name, CONFIG, ("--serial", serial))

    mirror = opened("17CW000#001")
    np.testing.assert_allclose(mirror.apply(SURFACE)[0], [100, -200, 300], atol=1e-3)
    np.testing.assert_allclose(mirror.dm.sent, [0.6, 0.3, 0.8, 0.5, 1, 0, 0, 0], atol=1e-7)
    mirror.dm.broken = True
    with pytest.raises(OSError, match="error 7"):
        mirror.apply(SURFACE)
    mirror.close()
    assert mirror.dm.closed
    with pytest.raises(ConfigurationError, match="cannot be opened: OSError: error 5"):
        opened("another")
    left_open: list[BmcDm] = []
    monkeypatch.setattr(BmcDm, "num_actuators", lambda dm: left_open.append(dm) or 1)
    with pytest.raises(ConfigurationError, match="each actuator needs its own channel below 1"):
        opened("17CW000#001")
    assert [dm.closed for dm in left_open] == [True]
