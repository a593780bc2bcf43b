"""R for the modes that the loop corrects: what the others measure is used as far as they are known to be small."""

import numpy as np

from lowfc.arrays import Array, Single, single
from lowfc.control.calibration.calibration import Calibration, noise_nm2
from lowfc.control.loop.camera import CameraSettings


def noise_covariance_nm2(calibration: Calibration, flux_dn: float, camera: CameraSettings | None) -> Array | None:
    """Covariance (modes, modes) of one frame's noise, nm^2 of wavefront rms, flux normalisation included.

    Photons of I0 and read-out; None where the camera's gain is not known.
    """
    if camera is None or not camera.gain_e_per_dn > 0 or not flux_dn > 0:
        return None
    em_gain = max(camera.em_gain, 1.0)
    excess = 2.0 if em_gain > 1 else 1.0
    flux_e = flux_dn * camera.gain_e_per_dn / em_gain
    read_noise_e = camera.read_noise_e / em_gain / excess**0.5
    R, I0 = calibration.reconstructor.astype(np.float64), calibration.reference.astype(np.float64)
    return excess * noise_nm2(R, I0, flux_e, read_noise_e)


def granted_rows(
    calibration: Calibration, prior_nm2: Array | Single, flux_dn: float, camera: CameraSettings | None
) -> Single:
    """R (modes, pixels) where some modes are left alone; the rows of (H'WH + P^-1)^-1 H'W for those that are not.

    R_g - C_gl (C_ll + P_l)^-1 R_l, with C the noise of the calibration's own R, which is unbiased, measured H or
    computed one. The rows of modes that are left stay as they are, so that what they measure stays unbiased.

    Args:
        calibration: In use.
        prior_nm2: (modes,) mean square of a mode that is left alone; 0 for one that the loop corrects.
        flux_dn: Sum of the good pixels, for the weights.
        camera: Its settings.
    """
    R, prior_nm2 = calibration.reconstructor, np.asarray(prior_nm2, np.float64)
    left = prior_nm2 > 0
    covariance = noise_covariance_nm2(calibration, flux_dn, camera)
    if covariance is None or not left.any() or left.all():
        return R
    among = covariance[np.ix_(left, left)] + np.diag(prior_nm2[left])
    mixed = np.linalg.solve(among, covariance[np.ix_(left, ~left)]).T
    rows = R.astype(np.float64)
    rows[~left] -= mixed @ rows[left]
    return single(rows)
