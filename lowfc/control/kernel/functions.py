"""The fused step: the arithmetic of a normal frame in plain functions, to be compiled.

The functions suit a compiler: they loop over existing arrays, allocate nothing, and call only each other and simple
functions of Python and numpy. Rows of R are processed ten at a time and the rest five at a time, so that each pixel
is read once for many rows and several sums run in parallel. `lowfc.adapters` compiles them.
"""

import numpy as np

from lowfc.arrays import Pixels, Sequences, Single


def scan(
    counts: Pixels, used: Pixels, dark: Single, tiles: Single, row: int, scratch: Single, sums_nm: Single
) -> tuple[np.uint64, np.uint16]:
    """Products of one block of a frame with R, in one pass over its counts.

    `counts`, `used` and `dark` are this block's part of `pixels`, `good` and `dark` in `measure`; `row` is the index in
    `tiles` of the block's first row. The products, not yet normalised, are in `sums_nm` (padded,):
    the number of modes, rounded up to a multiple of five.

    Returns:
        Sum of the used counts, and the highest used count.
    """
    total, highest, zero = np.uint64(0), np.uint16(0), np.float32(0)
    for i in range(counts.size):
        count = counts[i]
        scratch[i] = np.float32(count) - dark[i]
        used_count = count & used[i]
        total += np.uint64(used_count)
        highest = max(highest, used_count)
    mode, rows = 0, sums_nm.size
    while mode + 5 < rows:
        r0, r1, r2, r3, r4 = tiles[row], tiles[row + 1], tiles[row + 2], tiles[row + 3], tiles[row + 4]
        r5, r6, r7, r8, r9 = tiles[row + 5], tiles[row + 6], tiles[row + 7], tiles[row + 8], tiles[row + 9]
        s0, s1, s2, s3, s4 = zero, zero, zero, zero, zero
        s5, s6, s7, s8, s9 = zero, zero, zero, zero, zero
        for i in range(counts.size):
            value = scratch[i]
            s0 += r0[i] * value
            s1 += r1[i] * value
            s2 += r2[i] * value
            s3 += r3[i] * value
            s4 += r4[i] * value
            s5 += r5[i] * value
            s6 += r6[i] * value
            s7 += r7[i] * value
            s8 += r8[i] * value
            s9 += r9[i] * value
        for k, sum_nm in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9)):
            sums_nm[mode + k] = sum_nm
        mode, row = mode + 10, row + 10
    if mode < rows:
        r0, r1, r2, r3, r4 = tiles[row], tiles[row + 1], tiles[row + 2], tiles[row + 3], tiles[row + 4]
        s0, s1, s2, s3, s4 = zero, zero, zero, zero, zero
        for i in range(counts.size):
            value = scratch[i]
            s0 += r0[i] * value
            s1 += r1[i] * value
            s2 += r2[i] * value
            s3 += r3[i] * value
            s4 += r4[i] * value
        for k, sum_nm in enumerate((s0, s1, s2, s3, s4)):
            sums_nm[mode + k] = sum_nm
    return total, highest


def measure_blocks(
    pixels: Pixels,
    good: Pixels,
    dark: Single,
    tiles: Single,
    scratch: Single,
    first: int,
    last: int,
    sums_nm: Single,
    totals: Sequences,
) -> None:
    """`scan` the blocks from `first` to `last`, exclusive, so that several threads can share a frame.

    The results are written to `sums_nm` (blocks, padded) and `totals` (blocks, 2): sum of the used counts, and the
    highest used count. Each thread has its own `scratch`; the other arguments are as in `measure`.
    """
    block = scratch.size
    for number in range(first, last):
        begin, end, sums = number * block, (number + 1) * block, sums_nm[number]
        counts, used, dark_dn = pixels[begin:end], good[begin:end], dark[begin:end]
        total, highest = scan(counts, used, dark_dn, tiles, number * sums.size, scratch, sums)
        totals[number, 0], totals[number, 1] = total, highest


def measure(
    pixels: Pixels,
    good: Pixels,
    dark: Single,
    tiles: Single,
    scratch: Single,
    sums_nm: Single,
    totals: Sequences,
    reference_nm: Single,
    full_well: int,
    dark_sum_dn: float,
    least_dn: float,
    error_nm: Single,
) -> float:
    """Measured modes R (I - I0) of a frame in one pass over its counts.

    Args:
        pixels: (pixels,) counts, DN; empty if `measure_blocks` has filled the sums and totals.
        good: (pixels,) all bits set for a used pixel, else 0.
        dark: (pixels,) DN.
        tiles: (blocks x padded, block) R, one block of pixels after the other, padded with zeros; `padded` is the
            number of modes, rounded up to a multiple of five.
        scratch: (block,) overwritten.
        sums_nm: (blocks, padded) overwritten, or the sums if `pixels` is empty.
        totals: (blocks, 2) overwritten, or the totals if `pixels` is empty.
        reference_nm: (modes,) R I0.
        full_well: lowest count of a saturated pixel.
        dark_sum_dn: sum of the dark over the good pixels.
        least_dn: flux that the frame must exceed.
        error_nm: (modes,) the result, nm of wavefront rms.

    Returns:
        The flux, DN, rounded to float32: the exact sum of the good pixels minus `dark_sum_dn`. 0 if a good pixel is
        saturated, or the flux is not above `least_dn`.
    """
    modes, blocks = error_nm.size, totals.shape[0]
    if pixels.size:
        measure_blocks(pixels, good, dark, tiles, scratch, 0, blocks, sums_nm, totals)
    total, highest = np.uint64(0), np.uint64(0)
    for mode in range(modes):
        error_nm[mode] = 0
    for number in range(blocks):
        total += totals[number, 0]
        highest = max(highest, totals[number, 1])
        for mode in range(modes):
            error_nm[mode] += sums_nm[number, mode]
    flux_dn = np.float32(np.float64(total) - dark_sum_dn)
    if highest >= full_well or not flux_dn > least_dn:
        return 0.0
    scale = np.float32(1) / flux_dn
    for mode in range(modes):
        error_nm[mode] = error_nm[mode] * scale - reference_nm[mode]
    return float(flux_dn)


def respond(
    measured_nm: Single,
    seen_nm: Single,
    shift_nm: Single,
    target_nm: Single,
    previous_command_nm: Single,
    integrator: Single,
    x: Single,
    transition: Single,
    output: Single,
    from_error: bool,
    shapes: Single,
    added_nm: Single,
    previous_nm: Single,
    stroke_nm: float,
    slew_nm: float,
    neighbour_nm: float,
    results: Single,
    actuators_nm: Single,
) -> bool:
    """Compute the command of a closed loop, provided that no limit acts; modes are in nm of wavefront rms.

    Args:
        measured_nm: (modes,) result of `measure`.
        seen_nm: (modes,) command seen in the exposure.
        shift_nm: (modes,) the channels' shift of the sensor's zero point during the exposure.
        target_nm: (modes,) target of the loop.
        previous_command_nm: (modes,) last modal command.
        integrator: (3, modes) gain, fraction of the command that is kept, and limit, as in `Integrator.rows`.
        x: (states,) state of a linear law; empty for the integrator, like `transition` and `output`.
        transition: (states, states + 2 modes) F, G and U of a `LinearLaw`, side by side.
        output: (modes, states) K of the `LinearLaw`.
        from_error: whether the law's signal is the error, not the pseudo-open-loop modes minus the target.
        shapes: (modes, actuators) nm of surface per nm of wavefront.
        added_nm: (rows, columns) channels, nm of surface.
        previous_nm: (rows, columns) actuators of the last command, nm of surface.
        stroke_nm: largest deviation of an actuator from flat.
        slew_nm: largest move of an actuator.
        neighbour_nm: largest difference between neighbours.
        results: (3 modes + states,) output: error minus shift and target, pseudo-open-loop modes minus shift, command,
            and the new x.
        actuators_nm: (rows, columns) output: actuators of the command, nm of surface.

    Returns:
        Whether the results are valid: all numbers are finite, and no limit would change the command.
    """
    modes, states = measured_nm.size, x.size
    stroke, slew, neighbour = np.float32(stroke_nm), np.float32(slew_nm), np.float32(neighbour_nm)
    error_nm, pol_nm = results[:modes], results[modes : 2 * modes]
    command_nm, after = results[2 * modes : 3 * modes], results[3 * modes :]
    violations = 0
    for mode in range(modes):
        free_nm = measured_nm[mode] - shift_nm[mode]
        pol_nm[mode] = free_nm - seen_nm[mode]
        error_nm[mode] = free_nm - target_nm[mode]
        command_nm[mode] = integrator[1, mode] * previous_command_nm[mode] - integrator[0, mode] * error_nm[mode]
    for state in range(states):
        row, total = transition[state], np.float32(0)
        for i in range(states):
            total += row[i] * x[i]
        for mode in range(modes):
            signal = error_nm[mode] if from_error else pol_nm[mode] - target_nm[mode]
            total += row[states + mode] * signal + row[states + modes + mode] * previous_command_nm[mode]
        after[state] = total
    for mode in range(modes):
        if states:
            row, total = output[mode], np.float32(0)
            for i in range(states):
                total += row[i] * after[i]
            command_nm[mode] = total
        violations += not abs(command_nm[mode]) <= integrator[2, mode]
    if violations:
        return False
    rows, columns = previous_nm.shape
    flat, previous, added = actuators_nm.ravel(), previous_nm.ravel(), added_nm.ravel()
    for i in range(flat.size):
        flat[i] = added[i]
    for mode in range(modes):
        shape, value = shapes[mode], command_nm[mode]
        for i in range(flat.size):
            flat[i] += shape[i] * value
    for i in range(flat.size):
        violations += not abs(flat[i]) <= stroke
        violations += not abs(flat[i] - previous[i]) <= slew
    for i in range(columns, flat.size):
        violations += not abs(flat[i] - flat[i - columns]) <= neighbour
    for r in range(rows):
        line = actuators_nm[r]
        for i in range(1, columns):
            violations += not abs(line[i] - line[i - 1]) <= neighbour
    return not violations
