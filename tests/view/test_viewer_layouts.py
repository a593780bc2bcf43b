"""The viewer layouts in deploy/layouts: every path in them is a field of the message on the topic of the path.

If a field or topic is renamed, a test fails here rather than a layout during operation.
"""

import json
import re
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from rerun.chunk import RrdReader

from lowfc.contract.messages import EVENT, TRUTH, RawImage, Role, topic_of, wire
from lowfc.optics.chain.zernike import NOLLS_14, mode_name
from tools import layouts

LAYOUTS = Path(__file__).parents[2] / "deploy" / "layouts"
FOXGLOVE = json.loads((LAYOUTS / "foxglove.json").read_text())
PANELS: dict[str, dict[str, Any]] = FOXGLOVE["configById"]
PLOTJUGGLER = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()  # noqa: S314  # our own file
NOT_NUMBERS = {FieldDescriptor.CPPTYPE_MESSAGE, FieldDescriptor.CPPTYPE_STRING, FieldDescriptor.CPPTYPE_ENUM}
PLOTS = {name for name in PANELS if name.startswith("Plot!")}


def field_of(topic: str, path: list[str]) -> FieldDescriptor:
    """The field at the end of a path such as ["error_nm[0]"].

    Raises:
        KeyError: there is no such topic for a viewer, no such field, or an index is missing or superfluous.
    """
    declared = topic_of(topic.removeprefix("/"))
    if Role.VIEWER not in declared.subscribers:
        raise KeyError(topic)
    message: Descriptor = declared.message.DESCRIPTOR
    for number, part in enumerate(path):
        name, index = re.fullmatch(r"(\w+)(\[\d*\])?", part).groups()  # type: ignore[union-attr]
        field = message.fields_by_name[name]
        if field.is_repeated != (index is not None):
            raise KeyError(part)
        if number + 1 < len(path):
            message = field.message_type
    return field


def foxglove_field(path: str) -> FieldDescriptor:
    topic, _, fields = path.partition(".")
    return field_of(topic, fields.split("."))


def plotjuggler_field(curve: str) -> FieldDescriptor:
    """The field of a PlotJuggler curve, which joins topic and fields with slashes; no topic is a prefix of another."""
    parts = curve.split("/")
    for length in range(2, len(parts)):
        try:
            topic_of("/".join(parts[1:length]))
        except KeyError:
            continue
        return field_of("/".join(parts[:length]), parts[length:])
    raise KeyError(curve)


def leaves(node: Any) -> Iterator[str]:
    """Panels of a layout tree, including those in tabs."""
    if isinstance(node, str):
        yield node
        for tab in PANELS[node].get("tabs", ()):
            yield from leaves(tab["layout"])
    else:
        assert node["direction"] in ("row", "column")
        assert 0 < node["splitPercentage"] < 100
        yield from leaves(node["first"])
        yield from leaves(node["second"])


def test_every_panel_is_in_the_layout_once() -> None:
    assert FOXGLOVE.keys() == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert Counter(leaves(FOXGLOVE["layout"])) == Counter(PANELS.keys())
    kinds = {name.partition("!")[0] for name in PANELS}
    assert kinds == {"Tab", "Image", "Plot", "Indicator", "StateTransitions", "RosOut", "RawMessages"}
    for panel in PANELS.values():  # the two apps differ in the key of a title
        assert panel["foxglovePanelTitle"] == panel["lichtblickPanelTitle"] != ""


@pytest.mark.parametrize("name", sorted(PLOTS))
def test_plots_show_numeric_fields(name: str) -> None:
    paths = PANELS[name]["paths"]
    assert len({(path["color"], path["label"]) for path in paths}) == len(paths)
    for path in paths:
        assert foxglove_field(path["value"]).cpp_type not in NOT_NUMBERS
        assert path["enabled"]


def test_mode_plots_have_all_modes_with_their_names() -> None:
    names = [mode_name(noll) for noll in NOLLS_14]
    mode_plots = {name for name in PLOTS if [path["label"] for path in PANELS[name]["paths"]] == names}
    assert mode_plots == {"Plot!command", "Plot!error", "Plot!pol", "Plot!residual"}
    for name in mode_plots:
        indices = [re.findall(r"\[(\d+)\]", path["value"]) for path in PANELS[name]["paths"]]
        assert indices == [[str(index)] for index in range(len(names))]


def test_the_other_panels_show_their_topics() -> None:
    indicator = PANELS["Indicator!loop"]
    modes = {mode.name.removeprefix("LOOP_MODE_").lower(): mode.number for mode in wire.LoopMode.DESCRIPTOR.values}
    rules = {rule["label"]: int(rule["rawValue"]) for rule in indicator["rules"]}
    assert rules == {name: number for name, number in modes.items() if number != wire.LOOP_MODE_UNSPECIFIED}
    for path in (indicator["path"], *(path["value"] for path in PANELS["StateTransitions!mode"]["paths"])):
        assert foxglove_field(path).enum_type is not None
    for name in ("Image!frame", "Image!surface"):
        settings = PANELS[name]["imageMode"]
        assert topic_of(settings["imageTopic"].removeprefix("/")).message is RawImage
        assert settings["minValue"] < settings["maxValue"]
    assert PANELS["RosOut!events"]["topicToRender"] == f"/{EVENT.key}"
    assert topic_of(PANELS["RawMessages!health"]["topicPath"].removeprefix("/")).message is wire.Health


def test_the_curves_of_plotjuggler_are_numbers() -> None:
    tabs = {
        tab.get("tab_name"): [curve.get("name", "") for curve in tab.iter("curve")] for tab in PLOTJUGGLER.iter("Tab")
    }
    assert list(tabs) == ["modes", "residual", "mirror", "timing"]
    for curves in tabs.values():
        assert len(curves) > 10
        for curve in curves:
            assert plotjuggler_field(curve).cpp_type not in NOT_NUMBERS
    for splitter in PLOTJUGGLER.iter("DockSplitter"):  # PlotJuggler does not check its counts and sizes
        assert splitter.get("count") == str(len(splitter)) == str(len(splitter.get("sizes", "").split(";")))


NAMES = {"ViewBlueprint:display_name", "ViewBlueprint:space_origin", "SeriesLines:names"}
MAPPING = "VisualizerInstruction:component_map"


def rerun_layout(path: Path) -> tuple[str, Counter[str], set[tuple[str, str]]]:
    """Application id of a layout; counts of its views and names; component and selector of each mapping."""
    reader = RrdReader(path)
    (entry,) = reader.blueprints()
    names: Counter[str] = Counter()
    mappings: set[tuple[str, str]] = set()
    for chunk in reader.store(store=entry).stream():
        batch = chunk.to_record_batch()
        for name in NAMES & set(batch.schema.names):
            names.update(f"{name} {value}" for value in batch.column(name)[0].as_py())
        if MAPPING in batch.schema.names:
            mappings |= {(one["source_component"], one["selector"]) for one in batch.column(MAPPING)[0].as_py()}
    return entry.application_id, names, mappings


def test_rerun_layouts_are_up_to_date(tmp_path: Path) -> None:
    layouts.make(tmp_path)
    for name in ("lowfc.rbl", "log.rbl"):
        remedy = f"{name} is out of date: regenerate it with `python -m tools.measure layouts`"
        assert rerun_layout(LAYOUTS / name) == rerun_layout(tmp_path / name), remedy
    _, names, mappings = rerun_layout(LAYOUTS / "log.rbl")
    assert names[f"ViewBlueprint:space_origin /{TRUTH.key}"] == 2
    assert len(mappings) == 15
    for component, selector in mappings:
        message = getattr(wire, component.removeprefix("lowfc.v1.").removesuffix(":message"))
        first, *rest = selector.removeprefix(".").split(".")
        field = message.DESCRIPTOR.fields_by_name[first.partition("[")[0]]
        assert field.is_repeated == ("[" in first)
        assert rest == (["name"] if field.enum_type is not None else [])


def test_the_documented_rrd_route_writes_the_name_of_a_log_into_its_layout(tmp_path: Path) -> None:
    import rerun_cli

    routed = tmp_path / "log.rbl"
    arguments = ("rrd", "route", "--application-id", "night", LAYOUTS / "log.rbl", "-o", routed)
    subprocess.run([Path(rerun_cli.__file__).parent / "rerun", *arguments], capture_output=True, check=True)
    assert rerun_layout(routed) == ("night", *rerun_layout(LAYOUTS / "log.rbl")[1:])
