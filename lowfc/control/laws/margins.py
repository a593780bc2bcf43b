"""Closed-loop poles, margins, rejection and noise transfer of a linear law, for any true delay.

A frame measures error = disturbance + noise + B command with B(z) = sum_j w_j z^-(1+j), w from the true delay; the law
replies with command = -C error. Then L = C B, S = 1 / (1 + L) and T = L S. Coupled modes are evaluated one by one, with
the loops of the others closed: L of a mode is 1/S - 1.
"""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Complex, Integers, Mask
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.wording import counted

SAME_RATE = 0.01
"""Relative difference allowed between a law's frame rate and the camera's."""
MAX_COUPLED_STATES = 100
"""Most coupled states: computing the poles of this many takes about 30 ms."""

MAX_SETTLING_FRAMES = 4000
"""Upper limit of a law's settling time, frames."""

_GRID = 2048  # frequencies of each regular grid
_AROUND_POLE = np.concatenate([-np.geomspace(1e-2, 1e2, 33)[::-1], [0.0], np.geomspace(1e-2, 1e2, 33)])
"""Frequencies relative to a pole's, in units of the pole's distance from the unit circle."""
_LOWEST = 1e-6  # rad per frame: an integrator has no value at 0 Hz
_ROUNDING = 1e-6  # excess of poles above 1 allowed for single precision, but not in a driven closed loop


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of each mode, (modes,); all but `radius` are valid only if the loop is stable.

    Attributes:
        radius: largest modulus of the closed-loop poles of the mode (and of the modes coupled with it).
        gain_margin: factor by which the loop's gain may grow; infinite if there is no bound.
        gain_reduction: factor above which the gain must stay; 0 if there is no bound.
        phase_margin_deg: least change of phase, lag or lead, at which the loop oscillates; 180 if the loop never has a
            gain of 1.
        peak: largest `|S|`, the inverse of the modulus margin (the least distance of L from -1).
    """

    radius: Array
    gain_margin: Array
    gain_reduction: Array
    phase_margin_deg: Array
    peak: Array

    @property
    def stable(self) -> bool:
        """Whether every pole lies within the unit circle."""
        return bool((self.radius < 1).all())


def margins(law: LinearLaw, delay_frames: float) -> Margins:
    """Poles and margins of the loop that this law closes, when the true delay is `delay_frames`."""
    modes = len(law.noll)
    found = Margins(*(np.full(modes, fill) for fill in (0.0, np.inf, 0.0, 180.0, 1.0)))
    for part in _parts(law):
        poles = _poles(part.closed(delay_weights(delay_frames)))
        radius = float(np.abs(poles).max())
        found.radius[part.modes] = radius if part.driven or radius > 1 + _ROUNDING else min(radius, 1 - _ROUNDING)
        if not part.driven:
            continue
        omega = _frequencies(np.concatenate([poles, _poles(part.F + part.U @ part.K)]))
        S = part.sensitivity(omega, delay_weights(delay_frames))
        for place, mode in enumerate(part.modes.tolist()):
            own = S[:, place, place]
            loop = 1 / own - 1
            found.peak[mode] = np.abs(own).max()
            found.gain_margin[mode], found.gain_reduction[mode] = _gain_margins(loop)
            found.phase_margin_deg[mode] = _phase_margin_deg(loop)
    return found


def settling_frames(law: LinearLaw, delay_frames: float) -> int:
    """Five time constants of the slowest closed-loop pole at this delay, frames, at most `MAX_SETTLING_FRAMES`."""
    radius = float(margins(law, delay_frames).radius.max())
    return min(int(5 / max(1 - radius, 1e-9)) + 1, MAX_SETTLING_FRAMES)


def check_law(law: LinearLaw, delay_frames: float, rate_hz: float) -> None:
    """Refuse a law that was made for another loop; `rate_hz` is 0 if unknown.

    Raises:
        ValueError: the law's rate or (if its signal is "pol") its delay differs, or `check_stable` refuses it.
    """
    if law.signal == "pol" and abs(law.delay_frames - delay_frames) > 1e-3:
        raise ValueError(
            f"the law was made for a delay of {counted(law.delay_frames, 'frame')}, the loop has {delay_frames:g}: "
            "set control.delay_frames, or make a law for that delay"
        )
    if rate_hz and abs(law.rate_hz - rate_hz) > SAME_RATE * rate_hz:
        raise ValueError(
            f"the law was made for {law.rate_hz:g} Hz, the frames come at {rate_hz:g} Hz: make another with "
            "`lowfc tune` from a log of this rate"
        )
    check_stable(law, delay_frames)


def check_stable(law: LinearLaw, delay_frames: float) -> None:
    """Refuse a law that is unstable when closed, when open, or when frames are missing.

    The check needs only poles, and takes a fraction of the time of `margins`.

    Raises:
        ValueError: the law is unstable (the text names the pole), or more than `MAX_COUPLED_STATES` states are coupled.
    """
    weights = delay_weights(delay_frames)
    for part in _parts(law):
        if len(part.F) > MAX_COUPLED_STATES:
            raise ValueError(
                f"{len(part.F)} states of the law {law.name!r} are coupled; at most {MAX_COUPLED_STATES} may be, "
                "so that its stability can be checked quickly"
            )
        matrices = (
            ("closed", part.closed(weights)),
            ("open", part.F),
            ("without frames", part.A),
            ("without frames", part.A + part.U @ part.K),
        )
        for state, matrix in matrices:
            radius = float(np.abs(_poles(matrix)).max())
            unstable = radius >= 1 if part.driven and state == "closed" else radius > 1 + _ROUNDING
            if unstable:
                modes = ", ".join(f"Z{law.noll[mode]}" for mode in part.modes)
                true, own = (counted(float(delay), "frame") for delay in (delay_frames, law.delay_frames))
                raise ValueError(
                    f"the law {law.name!r} is unstable with a delay of {true}: {state}, {modes} has a pole at "
                    f"{radius:.4f}, it must be below 1 (the law was made for {own} at {law.rate_hz:g} Hz)"
                )


def rejection(law: LinearLaw, frequency_hz: Array, delay_frames: float | None = None) -> Array:
    """`|S|` (frequencies, modes) at frequencies in Hz: true residual over disturbance.

    The default delay is the law's.
    """
    return np.abs(sensitivity(law, 2 * np.pi * np.asarray(frequency_hz, float) / law.rate_hz, delay_frames))


def noise_transfer(law: LinearLaw, frequency_hz: Array, delay_frames: float | None = None) -> Array:
    """`|T|` (frequencies, modes) at frequencies in Hz: true residual over measurement noise of the same mode."""
    return np.abs(sensitivity(law, 2 * np.pi * np.asarray(frequency_hz, float) / law.rate_hz, delay_frames) - 1)


def noise_gain(law: LinearLaw, delay_frames: float | None = None, *, continuous: bool = False) -> Array:
    """Residual variance (modes,) caused by white measurement noise, divided by the variance of that noise in one frame.

    The residual is its mean over each exposure, which sees a mean of two commands if the delay is fractional. With
    `continuous`, it is the residual at all times, while the mirror holds each command for a period.
    """
    gain, weights = np.zeros(len(law.noll)), _weights(law, delay_frames)
    for part in _parts(law):
        if not part.driven:
            continue
        omega = _frequencies(_poles(part.closed(weights)))
        S = part.sensitivity(omega, weights)
        seen = np.polynomial.polynomial.polyval(np.exp(-1j * omega), weights) if continuous else 1.0
        for place, mode in enumerate(part.modes.tolist()):
            gain[mode] = np.trapezoid(np.abs((S[:, place, place] - 1) / seen) ** 2, omega) / np.pi
    return gain


def _weights(law: LinearLaw, delay_frames: float | None) -> Array:
    return delay_weights(law.delay_frames if delay_frames is None else delay_frames)


def sensitivity(law: LinearLaw, omega: Array, delay_frames: float | None = None) -> Complex:
    """Complex S (frequencies, modes) of each mode, at frequencies in rad per frame."""
    weights, omega = _weights(law, delay_frames), np.maximum(omega, _LOWEST)
    of_all_modes = np.ones((omega.size, len(law.noll)), complex)
    for part in _parts(law):
        S = part.sensitivity(omega, weights)
        of_all_modes[:, part.modes] = np.einsum("fmm->fm", S)
    return of_all_modes


@dataclass(frozen=True, slots=True)
class _Part:
    """Coupled states and modes of a `LinearLaw`, with its matrices in double precision."""

    modes: Integers
    F: Array
    G: Array
    U: Array
    A: Array
    K: Array
    own_weights: Array
    """Weights of the law's own delay, used in its measurement y; empty if y is the error."""

    @property
    def driven(self) -> bool:
        """Whether the measurement affects the command."""
        return bool(self.G.any() and self.K.any())

    def response(self, z: Complex) -> Complex:
        """Response of the command to an error, (frequencies, modes, modes)."""
        identity = np.eye(len(self.F))
        inside = identity - (self.F + self.U @ self.K) / z[:, None, None]
        response = self.K @ _solved(inside, np.broadcast_to(self.G.astype(complex), (z.size, *self.G.shape)))
        if not self.own_weights.size:
            return np.asarray(response)
        seen_by_law = np.polynomial.polynomial.polyval(1 / z, self.own_weights) / z
        return _solved(np.eye(len(self.modes)) + response * seen_by_law[:, None, None], response)

    def sensitivity(self, omega: Array, weights: Array) -> Complex:
        """S (frequencies, modes, modes), frequencies in rad per frame."""
        z = np.exp(1j * omega)
        seen = np.polynomial.polynomial.polyval(1 / z, weights) / z
        identity = np.eye(len(self.modes), dtype=complex)
        return _solved(identity - seen[:, None, None] * self.response(z), identity)

    def closed(self, weights: Array) -> Array:
        """Transition matrix of the closed loop for x[k-1], c[k-1], c[k-2], ..."""
        states, modes = len(self.F), len(self.modes)
        lags = max(weights.size, self.own_weights.size)
        sees = np.zeros(lags)
        sees[: weights.size] += weights
        sees[: self.own_weights.size] -= self.own_weights
        history = np.kron(sees, self.G)  # y[k] = sum_j sees_j c[k-1-j]
        history[:, :modes] += self.U
        state = np.hstack([self.F, history])
        command = self.K @ state
        older = np.eye(modes * (lags - 1), states + modes * lags, states)
        return np.vstack([state, command, older])


def _parts(law: LinearLaw) -> list[_Part]:
    """Split the law into independent parts."""
    matrices = (law.transition, law.measurement_gain, law.command_gain, law.predict_only, law.output)
    F, G, U, A, K = (matrix.astype(np.float64) for matrix in matrices)
    states, modes = len(F), len(law.noll)
    linked = np.block([[np.abs(F) + np.abs(A), np.abs(G) + np.abs(U)], [np.abs(K), np.zeros((modes, modes))]])
    label = _first_linked(linked + linked.T + np.eye(len(linked)) > 0)
    own = delay_weights(law.delay_frames) if law.signal == "pol" else np.zeros(0)
    parts = []
    for number in np.unique(label).tolist():
        x, m = np.flatnonzero(label[:states] == number), np.flatnonzero(label[states:] == number)
        if m.size and x.size:
            own_states, driving = np.ix_(x, x), np.ix_(x, m)
            parts.append(_Part(m, F[own_states], G[driving], U[driving], A[own_states], K[np.ix_(m, x)], own))
    return parts


def _first_linked(linked: Mask) -> Integers:
    """First member (n,) of each node's connected group, from links (n, n); importing scipy's takes 0.3 s."""
    while True:
        further = linked.astype(np.float32) @ linked.astype(np.float32) > 0
        if (further == linked).all():
            return np.asarray(np.argmax(linked, axis=1))
        linked = further


def _solved(matrices: Complex, right: Complex) -> Complex:
    """`numpy.linalg.solve` of a stack; for one unknown a division is several times faster."""
    return np.asarray(right / matrices if matrices.shape[-1] == 1 else np.linalg.solve(matrices, right))


def _poles(matrix: Array) -> Complex:
    return np.asarray(np.linalg.eigvals(matrix), dtype=np.complex128)


def _frequencies(poles: Complex) -> Array:
    """Frequencies from nearly 0 to pi rad per frame: an even grid, a logarithmic grid, and dense grids around poles."""
    near = poles[np.abs(poles) > 0.5]
    gap = np.maximum(np.abs(1 - np.abs(near)), 1e-9)
    around = np.abs(np.angle(near))[:, None] + gap[:, None] * _AROUND_POLE
    grids = (np.linspace(0, np.pi, _GRID), np.geomspace(_LOWEST, np.pi, _GRID), around.ravel())
    omega = np.unique(np.concatenate(grids))
    return np.asarray(omega[(omega >= _LOWEST) & (omega <= np.pi)])


def _gain_margins(loop: Complex) -> tuple[float, float]:
    """Growth and reduction of the gain at which L passes through -1, from its crossings of the negative real axis."""
    before, after = loop[:-1], loop[1:]
    crosses = np.signbit(before.imag) != np.signbit(after.imag)
    a, b = before[crosses], after[crosses]
    real = a.real - a.imag * (b.real - a.real) / (b.imag - a.imag)
    real = np.append(real, loop[-1].real)  # L is real at pi
    sizes = -real[real < 0]
    below, above = sizes[sizes < 1], sizes[sizes >= 1]
    return float(1 / below.max()) if below.size else np.inf, float(1 / above.min(initial=np.inf))


def _phase_margin_deg(loop: Complex) -> float:
    """Least angle between L and -1 where `|L|` = 1."""
    size = np.log(np.abs(loop))
    crosses = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
    share = size[crosses] / (size[crosses] - size[crosses + 1])
    at = loop[crosses] + share * (loop[crosses + 1] - loop[crosses])
    return float(np.degrees(np.abs(np.angle(-at)).min(initial=np.pi)))
