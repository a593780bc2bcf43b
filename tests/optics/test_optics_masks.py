"""Sparse-aperture layouts and pupils: the packaged ones, and files of users."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lowfc.adapters.files.layouts import layout_names, layout_warnings, load_layout
from lowfc.adapters.files.sensors import coronagraph_from, load_pupil, sensor_from
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.sections import SensorSection
from lowfc.optics.chain.coronagraph import DARK_ZONE, Wedge
from lowfc.optics.chain.sam import Layout, check, is_even_symmetric, transmission
from lowfc.programs.core.start_up import check_files

TWO_HOLES = {"purpose": "two holes", "hole_diameter": 0.1, "holes": [[0.1, 0.2], [-0.3, 0.0]]}


def written(tmp_path, content, name="mask.json"):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


PACKAGED = {
    **dict.fromkeys(("sam27d07", "sam27d07_bowtie", "sam27d07_bal14", "sam27_crb20"), 0.07),
    "sam27d10_bal14": 0.1,
    "sam18_sized": None,
}
"""Diameter of the holes, in pupil diameters; None if they differ."""


def test_packaged_layouts_are_valid():
    assert set(layout_names()) == set(PACKAGED)
    for name, diameter in PACKAGED.items():
        layout = load_layout(name)
        assert layout_warnings(layout) == []
        if diameter is not None:
            assert [hole[2] for hole in layout.holes] == [diameter] * 27
        open_area = transmission(layout, 512).mean()
        assert open_area == pytest.approx(np.pi / 4 * sum(hole[2] ** 2 for hole in layout.holes), rel=0.01)


def test_x_of_a_hole_runs_along_columns_and_y_along_rows():
    mask = transmission(Layout("one", "", ((0.3, -0.2, 0.1),)), 100)
    rows, columns = np.nonzero(mask)
    assert (rows.mean() + 0.5) / 100 - 0.5 == pytest.approx(-0.2)
    assert (columns.mean() + 0.5) / 100 - 0.5 == pytest.approx(0.3)


def test_a_hole_between_the_samples_is_refused():
    layout = Layout("tiny", "", ((0.2, 0.1, 0.07), (0.0, 0.0, 0.001)))
    with pytest.raises(ValueError, match=r"tiny: the hole at \(0.0, 0.0\) is lost between points 0\.002 D apart"):
        transmission(layout, 512)
    assert transmission(layout, 512, 16)[256, 256] > 0


@pytest.mark.parametrize(
    ("holes", "message"),
    [
        (((0.0, 0.0, 0.1), (0.09, 0.0, 0.1)), r"holes 0 at \(0.0, 0.0\) and 1 at \(0.09, 0.0\) overlap"),
        (((0.0, 0.0, 0.1), (0.1, 0.0, 0.2)), "overlap by 0.0500 D"),
        (((0.0, 0.0, 0.1), (0.0, 0.46, 0.1)), "hole 1 at .* reaches 0.5100 D"),
        ((), "at least one hole"),
        (((0.0, 0.0, 0.0),), "hole diameters"),
        (((float("nan"), 0.0, 0.1),), "finite"),
    ],
)
def test_invalid_layouts_are_refused(holes, message):
    with pytest.raises(ValueError, match=message):
        check(Layout("a", "", holes))


def test_holes_may_touch():
    check(Layout("touching", "", ((0.0, 0.0, 0.1), (0.1, 0.0, 0.1), (0.45, 0.0, 0.1))))


def test_even_symmetric_mask_gives_a_warning(tmp_path):
    even = Layout("even", "", ((0.2, 0.1, 0.1), (-0.2, -0.1, 0.1), (0.0, 0.0, 0.1)))
    assert is_even_symmetric(even)
    assert not is_even_symmetric(replace(even, holes=(*even.holes, (0.3, 0.2, 0.1))))
    assert not is_even_symmetric(replace(even, holes=((0.2, 0.1, 0.05), *even.holes[1:])))
    path = written(tmp_path, {"holes": even.holes})
    warnings = []
    sensor_from(SensorSection(sam=str(path)), warn=warnings.append)
    assert len(warnings) == 1
    assert "cannot sense even modes" in warnings[0]
    warnings.clear()
    sensor_from(warn=warnings.append)
    assert warnings == []


def test_layouts_are_read_from_files(tmp_path, monkeypatch):
    alone = load_layout(str(written(tmp_path, TWO_HOLES)))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_layout("~/mask.json") == alone
    assert alone == Layout("mask", "two holes", ((0.1, 0.2, 0.1), (-0.3, 0.0, 0.1)))
    one = written(tmp_path, {"layouts": {"x": TWO_HOLES}}, "one.json")
    assert load_layout(str(one)) == load_layout(f"{one}:x")
    folder = tmp_path / "a.json.d"  # looks like a file
    folder.mkdir()
    several = written(folder, {"layouts": {"x": TWO_HOLES, "y": TWO_HOLES}}, "several.json")
    assert load_layout(f"{several}:y").name == "y"
    with pytest.raises(ConfigurationError, match="no sparse-aperture layout is called"):
        load_layout(f"{folder}/several")
    with pytest.raises(ConfigurationError, match=r"several layouts.* x, y"):
        load_layout(str(several))
    with pytest.raises(ConfigurationError, match="'z'"):
        load_layout(f"{several}:z")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{not json", "not a readable JSON"),
        ("[]", "holds no layouts"),
        ({"layouts": {}}, "holds no layouts"),
        ({"layouts": {"x": {"holes": [[0, 0]]}}}, "hole_diameter"),
        ({"layouts": {"x": {**TWO_HOLES, "holes": [[0, 0, 0, 0]]}}}, "pairs"),
        ({"layouts": {"x": {**TWO_HOLES, "holes": [[0, 0], [0.05, 0]]}}}, "overlap"),
        ({"layouts": {"x": {**TWO_HOLES, "holes": [[0.49, 0]]}}}, "outside"),
        ({"layouts": {"x": {**TWO_HOLES, "holes": [[10**400, 0]]}}}, "OverflowError: 'int too large"),
        ({"layouts": {"x": 3}}, "layout x"),
    ],
)
def test_errors_name_the_path_of_a_damaged_layout_file(tmp_path, content, message):
    path = written(tmp_path, content)
    with pytest.raises(DataFileError, match=message) as caught:
        load_layout(str(path))
    assert str(path) in str(caught.value)


def test_missing_files_misspelt_names_and_impossible_values_are_refused():
    with pytest.raises(DataFileError, match=r"no layout file nowhere\.json"):
        load_layout("nowhere.json")
    with pytest.raises(ConfigurationError, match="did you mean 'sam27d07_bal14'"):
        load_layout("sam27d07_ball4")
    with pytest.raises(ConfigurationError, match="wavelength"):
        sensor_from(wavelength_nm=-1.0)
    with pytest.raises(ConfigurationError, match=r"lyot_stop = 0\.001: no sample"):
        check_files(load(None, {"sensor.pupil": "circle", "sensor.lyot_stop": 0.001}))


def test_the_dark_zone_of_a_pupil_file_is_the_one_it_was_designed_for(tmp_path):
    path = tmp_path / "pupil.npz"
    section, quarter = SensorSection(pupil=str(path)), np.ones((2, 2))
    np.savez(path, quarter=quarter, made_by=json.dumps({"inner": 3.0, "outer": 8.0, "half_angle_deg": 30.0}))
    assert coronagraph_from(section).dark_zone == Wedge(3.0, 8.0, 30.0)
    np.savez(path, quarter=quarter)
    assert coronagraph_from(section).dark_zone == DARK_ZONE
    for made_by, message in (
        ("another program", "inner"),
        ('{"inner": 4, "outer": 8}', "half_angle_deg"),
        ('{"inner": 8, "outer": 4, "half_angle_deg": 30}', "inner < outer"),
        ('{"inner": 4, "outer": 1e9, "half_angle_deg": 30}', "256 lambda/D"),
        ('{"inner": 4, "outer": 12, "half_angle_deg": 1}', "too thin"),
        (np.array("{}", dtype=object), "`made_by` must be the request of `lowfc design spc`, a text .*Object arrays"),
    ):
        np.savez(path, quarter=quarter, made_by=made_by)
        with pytest.raises(DataFileError, match=message):
            coronagraph_from(section)


def test_damaged_pupil_files_are_named(tmp_path):
    path = tmp_path / "pupil.npz"
    with pytest.raises(DataFileError, match="no pupil file"):
        load_pupil(file=path)
    np.savez(path, quarter=np.ones((4, 4)))
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataFileError, match="damaged"):
        load_pupil(file=path)
    np.savez(path, other=np.ones((4, 4)))
    with pytest.raises(DataFileError, match="quarter"):
        load_pupil(file=path)
    for quarter, message in (
        (np.full((4, 4), 1.5), "between 0 and 1"),
        (np.full((4, 4), np.nan), "between 0 and 1"),
        (np.ones((2, 3)), "square"),
        (np.zeros((4, 4)), "must exceed one half somewhere"),
        (np.full((4, 4), 0.45), "got at most 0.45"),
        (np.ones((4, 4)) + 0j, "real numbers"),
        (np.eye(4), r"pupil\.npz: .* 0 beyond .* a radius of 4 cells, got up to 1 in 1 cell: set these to 0"),
        (np.float64(1.0), "square"),
        (np.ones((0, 0)), "square"),
    ):
        np.savez(path, quarter=quarter)
        with pytest.raises(DataFileError, match=message):
            load_pupil(file=path)
    np.savez(path, quarter=np.ones((2, 2)))
    assert load_pupil(16, path).shape == (16, 16)
    with pytest.raises(ConfigurationError, match=r"pupil\.npz: .* of 4, twice .* 2 cells, got 10: resample"):
        load_pupil(10, path)
