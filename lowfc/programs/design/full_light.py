"""`lowfc design zwfs` and `lowfc design clowfs`: optimisation of the size of a sensor without a relay mask."""

from functools import cache
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from lowfc.adapters.files.drawing import figure_class, png
from lowfc.adapters.files.sensors import sensor_from
from lowfc.adapters.files.whole_file import require_folder, write_whole
from lowfc.contract.configuration import load
from lowfc.contract.sections import SensorSection
from lowfc.design.full_light import FocalLight, FullLight, sweep
from lowfc.design.goal import Goal, merit, predictions
from lowfc.design.merit import WAVELENGTH_NM
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.design.full_light_request import Sizes

KEYS = {"zwfs": "spot_diameter", "clowfs": "defocus_mm"}  # key of [sensor] with the size, by kind of sensor
_POINTS = 21  # sizes at which a sensor is evaluated before the optimisation


class Point(Result):
    """Predicted performance of a sensor of one size."""

    value: float = result_field("size", form=".3f")
    merit: float = result_field("merit", form=".4g")
    throughput: float = result_field("throughput", form=".1%")
    table3_waves: float = result_field("Table 3, n<=4", "waves", ".2e")
    table4_mas: float = result_field("Table 4, 2 modes", "mas", ".3f")
    condition: float = result_field("condition number, 14 modes", form=".0f")
    noise_nm: float = result_field("weighted noise of 14 modes, monochromatic", "nm", ".3g")
    contrast_noise: float = result_field("contrast from this noise", form=".2e")
    quantum_share: float = result_field("share of quantum limit", form=".1%")


class Sweep(Result):
    """Predicted performance of every size, and the best size."""

    key: str = result_field("key of [sensor]")
    merit: str = result_field("merit")
    estimator: str = result_field("estimator")
    best: float = result_field("best", form=".3f")
    file: str = result_field("written to")
    points: list[Point] = result_field()
    figures_of_best: dict[str, Any] = result_field()


def design(sizes: Sizes, goal: Goal, out: Path, plot: Path | None) -> Sweep:
    """Evaluate a sensor at several sizes, optimise between them, and write the keys of the best as a configuration."""
    if plot is not None:
        figure_class()  # report a missing package before the work, not after
    require_folder(out, plot)
    for end in (sizes.low, sizes.high):
        _section(sizes, end)  # validated here
    key = KEYS[sizes.kind]

    with threadpool_limits(1):
        focal_light = FocalLight.of(sensor_from(_section(sizes, sizes.low), WAVELENGTH_NM))

        @cache
        def candidate(value: float) -> FullLight:
            return FullLight(sensor_from(_section(sizes, value), WAVELENGTH_NM), focal_light)

        def merit_of(value: float) -> float:
            return merit(candidate(value), goal)

        values, best = sweep(merit_of, sizes.low, sizes.high, _POINTS)
        predicted = {value: predictions(candidate(value)) for value in sorted({*values.tolist(), best})}
        points = [_point(predicted[value], value, merit_of(value), goal) for value in predicted]
    keys = {"kind": f'"{sizes.kind}"', **sizes.others, key: f"{best:.6g}"}
    write_whole(out, "".join(["[sensor]\n", *(f"{name} = {value}\n" for name, value in keys.items())]).encode())
    if plot is not None:
        write_whole(plot, _picture(points, key, goal))
    return Sweep(
        key=key,
        merit=goal.merit,
        estimator=goal.estimator,
        best=best,
        file=str(out),
        points=points,
        figures_of_best=predicted[best],
    )


def _section(sizes: Sizes, value: float) -> SensorSection:
    """[sensor] of a sensor of this size; ConfigurationError if the size is not allowed."""
    keys = {"kind": sizes.kind, **sizes.others, KEYS[sizes.kind]: value}
    return load(None, {f"sensor.{name}": setting for name, setting in keys.items()}).sensor


def _point(predicted: dict[str, Any], value: float, merit_of_value: float, goal: Goal) -> Point:
    return Point(
        value=value,
        merit=merit_of_value,
        throughput=predicted["throughput"],
        table3_waves=predicted["table3_waves"][goal.estimator]["14"],
        table4_mas=max(predicted["table4_mas"][goal.estimator]["2"]),
        condition=predicted["condition"]["14"],
        noise_nm=predicted["noise_nm"],
        contrast_noise=predicted["contrast_noise"],
        quantum_share=predicted["quantum_share"],
    )


def _picture(points: list[Point], key: str, goal: Goal) -> bytes:
    """Predictions against size, relative to their minima (PNG)."""
    drawing = figure_class()(figsize=(7.5, 5.0), layout="constrained")
    axes = drawing.subplots()
    values = [point.value for point in points]
    labels = {
        "merit": f"merit {goal.merit}",
        "table3_waves": "Table 3",
        "table4_mas": "Table 4",
        "contrast_noise": "contrast from noise",
    }
    for name, label in labels.items():
        curve = [getattr(point, name) for point in points]
        axes.semilogy(values, [height / min(curve) for height in curve], label=label)
    axes.set(xlabel=key, ylabel="relative to minimum")
    axes.legend()
    return png(drawing)
