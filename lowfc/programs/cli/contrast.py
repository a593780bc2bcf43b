"""Contrast added to the dark zone by the wavefront: values and text shared by several commands."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lowfc.arrays import Array
from lowfc.optics.chain.added_contrast import ModalContrast, by_group, costliest


def added_contrast(contrast: ModalContrast | None, covariance_nm2: Mapping[str, Array | None]) -> dict[str, Any] | None:
    """Contrast added by wavefronts with these covariances (modes, modes), by name; None without a science image.

    Further keys: `by_group`, the contribution of each group of modes; `beyond_quadratic`, the names for which full
    images disagree with the quadratic form.
    """
    known = {name: one for name, one in covariance_nm2.items() if one is not None}
    if contrast is None or not known or any(len(one) != len(contrast.noll) for one in known.values()):
        return None
    each = {name: contrast.by_mode(one) for name, one in known.items()}
    return {
        **{name: float(each[name].sum()) if name in each else None for name in covariance_nm2},
        "by_group": {name: by_group(contrast.noll, one) for name, one in each.items()},
        "beyond_quadratic": [name for name, one in known.items() if contrast.is_beyond_quadratic(one)],
    }


def with_variances(covariance_nm2: Array, rms_nm: Array) -> Array:
    """Replace the sampled variances of a covariance (modes, modes) by the larger continuous-time ones (modes,).

    Off-diagonal terms come from command noise, which is constant over the period.
    """
    return np.asarray(covariance_nm2 + np.diag(rms_nm**2 - np.diag(covariance_nm2)))


def most_of(known: Mapping[str, Any]) -> tuple[str, float] | None:
    """The modes that contribute most to the added contrast, from a camera's statistics of the wavefront."""
    most = known["costliest_modes"]
    return None if most is None else (most["modes"], most["share"])


def with_this_mirror(added: Mapping[str, float]) -> dict[str, float | None]:
    """Contrast added with a flat mirror, and by the residual with the present mirror shape, in any loop mode."""
    return {"flat mirror": added["open"], "residual": added["closed"]}


def contrast_in_words(
    added: Mapping[str, float | None], most: tuple[str, float] | None, beyond: Sequence[str] = ()
) -> str:
    """The added contrast of each case, and the modes that contribute most to the last one."""
    cases = ", ".join(f"{name} {one:+.1e}" for name, one in added.items() if one is not None)
    largest = "" if most is None else f"; {most[0]} contributes most ({100 * most[1]:.0f} %)"
    caveat = f"; beyond quadratic, full images differ by more than 10 %: {', '.join(beyond)}" if beyond else ""
    return f"added to the dark zone's contrast: {cases}{largest}{caveat}"


def added_contrast_in_words(found: Mapping[str, Any]) -> str:
    """The result of `added_contrast` in words."""
    groups, beyond = found["by_group"], found["beyond_quadratic"]
    added = {name: one for name, one in found.items() if name not in ("by_group", "beyond_quadratic")}
    return contrast_in_words(added, costliest(next(reversed(groups.values()))), beyond)
