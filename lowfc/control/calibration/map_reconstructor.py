"""Maximum-a-posteriori (MAP) reconstructor of the corrected modes, with a prior for the uncorrected modes."""

from functools import lru_cache

import numpy as np

from lowfc.arrays import Array, Single, single
from lowfc.control.calibration.calibration import Calibration, scaled_noise_nm2, unit_noise_nm2
from lowfc.control.loop.camera import CameraSettings


@lru_cache(maxsize=2)  # slow; automatic gains need it between two frames
def unit_covariances_nm2(calibration: Calibration) -> tuple[Array, Array]:
    """Covariances (modes, modes), nm^2, of photon noise and of read noise for the own R: see `unit_noise_nm2`."""
    return unit_noise_nm2(calibration.reconstructor.astype(np.float64), calibration.reference.astype(np.float64))


def noise_covariance_nm2(calibration: Calibration, flux_dn: float, camera: CameraSettings | None) -> Array | None:
    """Covariance (modes, modes), nm^2, of the noise of the modes measured from one frame divided by its flux.

    It includes the photon noise of a frame whose image is I0, and read noise. None if the camera's gain or the flux is
    unknown.
    """
    if camera is None or not camera.gain_e_per_dn > 0 or not flux_dn > 0:
        return None
    em_gain = max(camera.em_gain, 1.0)
    excess = 2.0 if em_gain > 1 else 1.0
    flux_e = flux_dn * camera.gain_e_per_dn / em_gain
    read_noise_e = camera.read_noise_e / em_gain / excess**0.5
    return excess * scaled_noise_nm2(unit_covariances_nm2(calibration), flux_e, read_noise_e)


def map_rows(
    calibration: Calibration,
    prior_nm2: Array | Single,
    flux_dn: float,
    camera: CameraSettings | None,
    *matrices: Single,
) -> list[Single]:
    """Replace the rows M_c of the corrected modes c, in each matrix M, by M_c - C_cu (C_uu + P_u)^-1 M_u.

    The rows M_u of the uncorrected modes u are unchanged. M (modes, columns) is for example R; P_u is
    the prior of these modes, and C the noise covariance of the calibration's own R. If this R is the weighted one for
    the same flux, the new rows of R are (H'WH + P^-1)^-1 H'W, with W the pixels' inverse variances, and
    P^-1 = 0 for the corrected modes.

    Args:
        calibration: The calibration in use.
        prior_nm2: (modes,) mean square of an uncorrected mode; 0 for a corrected mode.
        flux_dn: Sum of the good pixels, DN, from which C is computed; if not above 0, the matrices are unchanged.
        camera: Camera settings; if they or their gain are unknown, or no mode or every mode is corrected, the matrices
            are returned unchanged.
        matrices: The matrices M.
    """
    prior_nm2 = np.asarray(prior_nm2, np.float64)
    uncorrected = prior_nm2 > 0
    covariance = noise_covariance_nm2(calibration, flux_dn, camera)
    if covariance is None or not uncorrected.any() or uncorrected.all():
        return list(matrices)
    among = covariance[np.ix_(uncorrected, uncorrected)] + np.diag(prior_nm2[uncorrected])
    mixed = np.linalg.solve(among, covariance[np.ix_(uncorrected, ~uncorrected)]).T
    mapped = [matrix.astype(np.float64) for matrix in matrices]
    for rows in mapped:
        rows[~uncorrected] -= mixed @ rows[uncorrected]
    return list(map(single, mapped))
