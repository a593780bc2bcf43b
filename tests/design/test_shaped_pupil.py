"""The design of a shaped pupil: its linear programs, the command, and the mask of the package."""

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from importlib import resources
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.special import j0, j1

from lowfc.adapters.files.sensors import coronagraph_from, load_pupil
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.sections import SensorSection
from lowfc.design import shaped_pupil
from lowfc.design.linear_program import NotSolvedError
from lowfc.design.shaped_pupil import Request, exchange, in_shortest_type, is_feasible, properties, relative_field
from lowfc.optics.chain.added_contrast import ModalContrast
from lowfc.optics.chain.fourier import to_image
from lowfc.optics.chain.grid import OPEN_AREA, SAMPLES, image_axis, pupil_axis
from lowfc.optics.chain.pupil import circle, from_quarter
from lowfc.optics.chain.zernike import NOLLS_14
from tests.support.loops import json_of, lowfc, refusal

SMALL = Request(outer=8.0, cells=16)
PACKAGED = resources.files("lowfc") / "data" / "spc_quarter128.npz"


def designed(request):
    """Result of the last linear program."""
    return list(exchange(request))[-1]


def field_of(quarter, samples_per, extent):
    """Axis, lambda/D, and the field on its grid by the sensor's transform, relative to the field's peak.

    The samples are at half-integer multiples of their spacing. With `samples_per` = 30 per lambda/D, none of them is a
    point at which the design is checked.
    """
    pupil = from_quarter(quarter, SAMPLES)
    axis = image_axis(2 * extent * samples_per, samples_per)
    return axis, to_image(pupil.astype(complex), axis.size, samples_per, 1.0) / pupil.mean()


def in_zone(request, axis, margin=0.0):
    """Whether each point of the grid of an axis is in the dark zone, at least `margin` (lambda/D) from its edge."""
    radius, angle = np.hypot(axis[:, None], axis), np.rad2deg(np.arctan2(np.abs(axis)[:, None], np.abs(axis)))
    return (
        (radius >= request.inner + margin)
        & (radius <= request.outer - margin)
        & (angle <= request.half_angle_deg - np.rad2deg(margin / request.inner))
    )


def test_field_agrees_with_the_sensor_transform():
    quarter = np.random.default_rng(1).random((16, 16))
    axis, field = field_of(quarter, 7, 9)
    np.testing.assert_allclose(relative_field(quarter, axis), field, atol=1e-12)


def test_properties_of_the_open_circle_agree_with_closed_forms():
    found = properties(circle(512)[256:, 256:], Request())
    assert found.open_area_fraction == pytest.approx(1.0, abs=1e-3)
    assert found.energy_fraction == found.open_area_fraction
    encircled = 1.0 - j0(4 * np.pi) ** 2 - j1(4 * np.pi) ** 2
    assert found.focal_mask_fraction == pytest.approx(encircled, abs=2e-3)  # the sampled disk has a staircase rim
    assert found.grey_cells_fraction == 0.0


def test_first_program_has_the_same_optimum_as_another_formulation_and_solver():
    """Other formulation: full pupil without symmetry, field as a plain sum, full wedge, interior-point method."""
    request = replace(SMALL, limit=1.0)
    first = next(exchange(request))
    assert first.bound == pytest.approx(first.open_area, abs=1e-9)
    axis, half_angle_rad = np.arange(17) / 2, np.deg2rad(request.half_angle_deg)
    row, column = np.nonzero(in_zone(request, axis, -1e-9))
    edges = [(r, a) for r, count in ((4.0, 7), (8.0, 13)) for a in np.linspace(0, half_angle_rad, count)]
    edges += [(r, half_angle_rad) for r in np.linspace(4, 8, 9)]
    x = np.concatenate([axis[column], [r * np.cos(a) for r, a in edges]])
    y = np.concatenate([axis[row], [r * np.sin(a) for r, a in edges]])
    u, samples = pupil_axis(32), np.arange(-7.5, 8.0) / SAMPLES
    v, h = (position[circle(32) > 0] for position in np.meshgrid(u, u, indexing="ij"))
    # Transform of one square cell of the pupil, from its samples.
    square = np.cos(2 * np.pi * np.outer(x, samples)).mean(1) * np.cos(2 * np.pi * np.outer(y, samples)).mean(1)
    fields = [np.cos(2 * np.pi * (np.outer(x, h) + np.outer(side * y, v))) * square[:, None] for side in (-1, 1)]
    field, level = np.vstack(fields), np.sqrt(request.contrast)
    alternative = linprog(
        -np.ones(v.size),
        A_ub=np.vstack([field - level, -field - level]),
        b_ub=np.zeros(4 * x.size),
        bounds=(0, 1),
        method="highs-ipm",
    )
    assert -alternative.fun / 32**2 / OPEN_AREA == pytest.approx(first.open_area, abs=1e-6)


@pytest.mark.usefixtures("without_layout")
def test_command_writes_a_mask_that_meets_the_contrast_between_the_points_of_its_design(tmp_path):
    path, picture = tmp_path / "spc.npz", tmp_path / "spc.png"
    result = json_of("design", "spc", "--outer", 8, "--cells", 64, "--out", path, "--plot", picture)
    assert result["open_area_fraction"] == pytest.approx(0.5317, abs=5e-4)
    assert abs(result["below_optimum_at_limit_fraction"]) < 1e-6
    assert picture.read_bytes().startswith(b"\x89PNG")
    pupil = load_pupil(file=path)
    assert pupil.mean() / OPEN_AREA == pytest.approx(result["open_area_fraction"], abs=1e-12)
    assert (pupil <= circle(SAMPLES // 4).repeat(4, 0).repeat(4, 1)).all()  # no cell outside the circle is open
    with np.load(path) as file:
        request = Request(**json.loads(str(file["made_by"])))
        quarter = file["quarter"].astype(float)
    assert request == Request(outer=8.0, cells=64)
    assert properties(quarter, request).max_contrast == result["max_contrast"] <= request.contrast
    axis, field = field_of(quarter, 30, 8)
    zone = in_zone(request, axis)
    assert (np.abs(field[zone]) ** 2).max() < 1.1 * request.contrast
    assert (np.abs(field[zone]) ** 2).mean() == pytest.approx(result["mean_contrast"], rel=0.05)
    modal = ModalContrast(coronagraph_from(SensorSection(pupil=str(path))), NOLLS_14, 550.0)
    assert modal.by_image(np.zeros(14)) == pytest.approx(result["mean_contrast"], rel=0.2)
    assert (np.diag(modal.form) > 0).all()


def test_design_is_reproducible():
    first, again = designed(SMALL), designed(SMALL)
    assert first.contrast <= SMALL.contrast
    np.testing.assert_array_equal(first.quarter, again.quarter)


def test_a_mask_with_octant_symmetry_is_as_open_as_one_with_quarter_symmetry():
    request = replace(SMALL, half_angle_deg=90.0, limit=0.98)
    octant = designed(replace(request, symmetry="octant"))
    np.testing.assert_array_equal(octant.quarter, octant.quarter.T)
    assert octant.contrast <= request.contrast
    assert octant.open_area == pytest.approx(designed(request).open_area, abs=1e-4)


def test_mask_is_stored_in_the_shortest_type_that_meets_the_contrast():
    mask = designed(SMALL)
    kinds = {in_shortest_type(mask.quarter, replace(SMALL, contrast=contrast)).dtype for contrast in (1e-9, 1e-7)}
    assert kinds == {np.dtype(np.float32), np.dtype(np.float16)}


def test_infeasible_request_reports_the_nearest_feasible_one(tmp_path):
    path = tmp_path / "spc.npz"
    arguments = ["spc", "--inner", "2.5", "--outer", "5", "--cells", "16", "--out", str(path)]
    error = refusal("design", *arguments, kind=ConfigurationError)
    assert "inner radius 2.5 lambda/D at contrast 1e-09 is infeasible" in error
    nearest = r"nearest feasible inner radius is (\S+) \(same contrast\), or contrast is (\S+) \(same radius\)"
    inner, contrast = map(float, re.search(nearest, error).groups())
    request = replace(SMALL, inner=2.5, outer=5.0)
    assert is_feasible(replace(request, inner=inner))
    assert not is_feasible(replace(request, inner=inner - 0.1))
    assert is_feasible(replace(request, contrast=contrast))
    assert not is_feasible(replace(request, contrast=contrast / 10**0.1))  # one step of the search further
    assert not path.exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cells": 100}, "cells must be 8, 16"),
        ({"outer": 20.0, "cells": 16}, "16 lambda/D"),
        ({"inner": 20.0}, "20 to 20"),
        ({"inner": 4.01, "outer": 4.09, "half_angle_deg": 1.0}, "at least 0.1 lambda/D further out"),
        ({"half_angle_deg": 95.0}, "half-angle"),
        ({"contrast": 0.0}, "contrast must"),
        ({"limit": 1.1}, "limit"),
        ({"step": 0.0}, "step"),
        ({"symmetry": "half"}, "one of quarter, octant, got 'half'"),
        ({"rounds": 0}, "one round"),
    ],
)
def test_invalid_requests_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Request(**values)


def test_too_few_rounds_are_an_error_and_leave_no_file(tmp_path):
    arguments = ["spc", "--outer", "8", "--cells", "16", "--rounds", "1", "--out", str(tmp_path / "spc.npz")]
    advice = refusal("design", *arguments, kind=ConfigurationError)
    assert "after 1 linear program with 16 cells the contrast is" in advice
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("failure", "reported"),
    [(NotSolvedError("the solver failed"), ConfigurationError), (ValueError("a bug"), ValueError)],
)
def test_only_solver_failures_become_configuration_errors(tmp_path, monkeypatch, failure, reported):
    monkeypatch.setattr(shaped_pupil, "maximise", Mock(side_effect=failure))
    error = lowfc("design", "spc", "--out", tmp_path / "spc.npz").exception
    assert type(error) is reported
    assert str(error) == str(failure)


@pytest.mark.parametrize(
    ("out", "reported", "message"),
    [("nowhere/spc.npz", DataFileError, "there is no directory"), ("spc.fits", ConfigurationError, "must end in .npz")],
)
def test_unusable_file_is_reported_before_the_design(tmp_path, out, reported, message):
    assert message in refusal("design", "spc", "--out", tmp_path / out, kind=reported)


def test_ctrl_c_interrupts_a_linear_program_and_leaves_no_file(tmp_path):
    source = "from lowfc.adapters.process.terminal import run_app; from lowfc.programs.design.command import design_app"
    command = [sys.executable, "-c", f"{source}; run_app(design_app)", "spc", "--outer", "8"]
    command += ["--out", str(tmp_path / "spc.npz")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert "cells, program  1" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate()
    assert process.returncode == 130
    assert stderr.endswith("interrupted\n")
    assert list(tmp_path.iterdir()) == []


def packaged():
    """Quarter of the packaged mask, and the request that it records."""
    with PACKAGED.open("rb") as stream, np.load(stream) as file:
        return file["quarter"].astype(float), Request(**json.loads(str(file["made_by"])))


def test_packaged_mask_meets_its_recorded_request():
    quarter, request = packaged()
    assert request == Request()
    found = properties(quarter, request)
    assert found.max_contrast <= request.contrast == 1e-9
    assert found.open_area_fraction > 0.26


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_recorded_request_reproduces_the_packaged_mask():
    quarter, request = packaged()
    again = designed(request)
    assert again.contrast <= request.contrast
    assert again.open_area == pytest.approx(quarter.mean() / OPEN_AREA, abs=1e-4)
    assert (np.abs(again.quarter - quarter) > 0.5).mean() < 1e-3
