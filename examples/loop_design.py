"""Highest integrator gain within the margins at several delays, and the residual of a vibration.

Example: python examples/loop_design.py 17 500
"""

import sys
from collections.abc import Iterator

import numpy as np

from lowfc.control.laws.stability import highest_gain, limiting_gain, open_loop


def design(line_hz: float, rate_hz: float) -> Iterator[str]:
    """Yield a heading, then a row for each delay: highest gain within the margins, and what remains of the line."""
    yield f"a line of {line_hz:g} Hz, {rate_hz:g} frames per second"
    yield "delay, frames   oscillates at gain   highest gain   residual / line   bandwidth, Hz"
    frequency_hz = np.linspace(0.1, rate_hz / 2, 20_000)
    for delay in (1.0, 1.5, 2.0, 3.0):
        gain = highest_gain(delay)
        loop_gain = open_loop(2 * np.pi * frequency_hz / rate_hz, gain, 0.0, delay)
        rejection = np.abs(1 / (1 + loop_gain))  # residual over disturbance, as the sensor measures it once a frame
        bandwidth_hz, line_ratio = frequency_hz[np.argmax(rejection > 1)], np.interp(line_hz, frequency_hz, rejection)
        yield f"{delay:13g}   {limiting_gain(delay):18.2f}   {gain:12.2f}   {line_ratio:15.2f}   {bandwidth_hz:13.1f}"


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in design(float(sys.argv[1]), float(sys.argv[2])))
