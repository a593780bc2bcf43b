"""Virtual integrators (parallel loops with other gains), compared with separate loops that have their gains."""

import numpy as np

from lowfc.control.laws.integrator import Integrator, integrate
from lowfc.control.laws.virtual import VirtualIntegrators


def test_each_row_has_the_errors_and_commands_of_a_loop_with_its_gain() -> None:
    rng = np.random.default_rng(1)
    half = np.float32(0.5)  # weight of each of two commands: a delay of 1.5 frames
    gain = np.array([[0, 0], [0.1, 0.4], [0.3, 0.2]], np.float32)
    leak, limit = np.array([0, 0.01], np.float32), np.array([2.0, 100], np.float32)
    rows = VirtualIntegrators.at_rest(gain, 1 - leak, limit, ((0, half), (1, half)))
    laws, commands = [Integrator(row, leak, limit) for row in gain], [[np.zeros(2, np.float32)] * 2 for _ in gain]
    for frame in range(200):
        if frame % 50 == 7:  # missing: the command is held
            rows = rows.held()
            commands = [[newest, newest] for newest, _ in commands]
            continue
        pol = rng.normal(0, 3, 2).astype(np.float32)
        rows, errors = rows.advanced(pol)
        for row, law in enumerate(laws):
            newest, older = commands[row]
            error = pol + half * newest + half * older
            np.testing.assert_allclose(errors[row], error, atol=1e-4)
            commands[row] = [integrate(law, newest, error)[0], newest]
        np.testing.assert_allclose(rows.history_nm[0], [newest for newest, _ in commands], atol=1e-4)


def test_differences_of_squared_errors_equal_differences_of_squared_true_residuals() -> None:
    """Both are averaged over 20,000 frames of a slow drift with several times stronger noise."""
    rng = np.random.default_rng(2)
    gain = np.array([0, 0.02, 0.5], np.float32)[:, None] * np.ones((1, 40), np.float32)
    ones = np.ones(40, np.float32)
    weights = ((0, np.float32(1)),)
    rows = VirtualIntegrators.at_rest(gain, ones, 1e9 * ones, weights)
    drift = np.cumsum(rng.normal(0, 0.05, (20_000, 40)), axis=0).astype(np.float32)
    measured, true = np.zeros((3, 40)), np.zeros((3, 40))
    for disturbance in drift:
        noise = rng.normal(0, 30, 40).astype(np.float32)
        residual = disturbance + rows.history_nm[0]
        rows, errors = rows.advanced(disturbance + noise)
        measured += errors**2 - errors[0] ** 2
        true += residual**2 - residual[0] ** 2
    difference = (measured - true)[1:].mean(axis=1) / len(drift)
    spread = (measured - true)[1:].std(axis=1) / len(drift) / np.sqrt(40)
    assert (np.abs(difference) < 4 * spread).all()
    assert (true[1] < 0).mean() > 0.5  # the low gain reduces the residual
    assert (true[2] > 0).all()  # the high gain adds noise
