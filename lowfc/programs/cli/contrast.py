"""Contrast added to the dark zone by the wavefront: values and text shared by several commands."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lowfc.arrays import Array
from lowfc.optics.chain.added_contrast import ModalContrast, by_group, costliest

QUADRATIC = "; quadratic form, valid to 3 nm rms of a mode"
"""Method for the added contrast of a running loop. To 3 nm rms of a mode, full images agree to 10 % (shaped pupil)."""
ESTIMATED = ", estimated from the sensor"
"""Source of the added contrast of a running loop whose true wavefront is not known."""


def added_contrast(contrast: ModalContrast | None, covariance_nm2: Mapping[str, Array | None]) -> dict[str, Any] | None:
    """Contrast added by wavefronts with these covariances (modes, modes), by name; None if the covariance is None.

    Further keys: `by_group`, the contribution of each group of modes; `beyond_quadratic`, the names for which full
    images differ from the quadratic form. The result is None without a `contrast` or without a covariance, or if the
    numbers of modes differ.
    """
    given_nm2 = {name: covariance for name, covariance in covariance_nm2.items() if covariance is not None}
    if contrast is None or not given_nm2 or any(len(each) != len(contrast.noll) for each in given_nm2.values()):
        return None
    by_mode = {name: contrast.by_mode(covariance) for name, covariance in given_nm2.items()}
    return {
        **{name: float(by_mode[name].sum()) if name in by_mode else None for name in covariance_nm2},
        "by_group": {name: by_group(contrast.noll, values) for name, values in by_mode.items()},
        "beyond_quadratic": [name for name, each in given_nm2.items() if contrast.is_beyond_quadratic(each)],
    }


def with_variances(covariance_nm2: Array, rms_nm: Array) -> Array:
    """Replace the variances of a sampled covariance (modes, modes) by those of the continuous-time rms (modes,).

    The covariances between modes stay: they come from command noise, which is constant over a period.
    """
    return np.asarray(covariance_nm2 + np.diag(rms_nm**2 - np.diag(covariance_nm2)))


def costliest_modes(statistics: Mapping[str, Any]) -> tuple[str, float] | None:
    """The modes that add most contrast, and their share of it, from the statistics of `launch.watch.wavefront`."""
    most = statistics["costliest_modes"]
    return None if most is None else (most["modes"], most["share"])


def contrast_cases(added: Mapping[str, float]) -> dict[str, float | None]:
    """Added contrast by label: with a flat mirror, and with the present mirror shape, even if the loop is open."""
    return {"flat mirror": added["open"], "residual": added["closed"]}


def contrast_in_words(
    added: Mapping[str, float | None], costliest: tuple[str, float] | None, beyond: Sequence[str] = (), method: str = ""
) -> str:
    """Text of each case's added contrast, of the costliest modes of the last case and their share, and of the method.

    A caveat names the cases in `beyond`, for which full images differ from the quadratic form.
    """
    cases = ", ".join(f"{name} {value:+.1e}" for name, value in added.items() if value is not None)
    share = "" if costliest is None else f"; {costliest[0]} contributes most ({100 * costliest[1]:.0f} %)"
    caveat = f"; full images differ from the quadratic form by more than 10 %: {', '.join(beyond)}" if beyond else ""
    return f"added to the dark zone's contrast: {cases}{share}{method}{caveat}"


def added_contrast_in_words(result: Mapping[str, Any]) -> str:
    """The result of `added_contrast` in words."""
    groups, beyond = result["by_group"], result["beyond_quadratic"]
    added = {name: value for name, value in result.items() if name not in ("by_group", "beyond_quadratic")}
    return contrast_in_words(added, costliest(next(reversed(groups.values()))), beyond)
