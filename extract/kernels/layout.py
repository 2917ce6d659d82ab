"""Which rows a folded system keeps, and where its integer part has what: the half of folding that moves no weights.

Rows are chosen and moved eight at a time.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import store
from mn_onnx.extract.kernels.masks import (
    at_least,
    bits_of,
    both,
    choose,
    count_before,
    count_bits,
    count_up,
    is_below,
    load_integers,
    lowest_bit,
    mask_of,
    pack_store,
    splat_integer,
    without,
)
from mn_onnx.extract.kernels.memory import (
    KEPT,
    KEPT_ROWS,
    KIND,
    OLD_COL,
    PLACE,
    SETTLED_ROW,
    STABLE_COLS,
    STATE_HIGH,
    STATE_LOW,
    SYS_COLS,
    SYS_FLOATS,
    SYS_HASH,
    SYS_HEADER,
    SYS_INTS,
    SYS_LEVELS,
    SYS_ROWS,
    SYS_SINGLE,
    SYS_UNITS,
    padded,
    system_floats,
    system_ints,
)
from mn_onnx.ir.kernel import kernel

# Systems of so many units are large.
ALIGNED_UNITS = 64


@kernel
def choose_rows(N, J, M, system, folded, least):
    """Which rows of the system stay: those of kind ``least`` or more, and others to pad each level to the lane width.

    For every eight old rows J[KEPT] has the bits of those that stay and J[PLACE] the new row of the first of them;
    J[KEPT_ROWS] has the old row of every new one, and if every unit has one output, J[OLD_COL] the old column of every
    new one. Writes the folded system's levels and units; returns its number of rows.
    """
    rows, levels = N[system + SYS_ROWS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    new_level_start = folded + SYS_HEADER
    new_rows, new_levels, new_units = np.int64(0), np.int64(0), 0
    N[new_level_start] = 0
    # Levels of large systems begin where cache lines do; in small systems padding would cost more.
    uneven = 7 if N[system + SYS_UNITS] >= ALIGNED_UNITS else 3
    for chunk in range((rows + 7) >> 3):
        J[KEPT * M + chunk] = 0
    for level in range(levels):
        begin, end = N[level_start + level], N[level_start + level + 1]
        count = 0
        for chunk in range(begin >> 3, (end + 7) >> 3):
            r = 8 * chunk
            unstable = at_least(load_integers(J, KIND * M + r), splat_integer(least))
            real = at_least(load_integers(N, row_unit + r), splat_integer(0))
            bits = bits_of(both(real, unstable)) & level_bits(r, begin, end)
            J[KEPT * M + chunk] |= bits
            count += count_bits(bits)
        if count == 0:
            continue
        new_units += count
        chunk = begin >> 3
        while count & uneven:
            # Padding is a row that is left out: finite, and read by nothing.
            free = level_bits(8 * chunk, begin, end) & ~J[KEPT * M + chunk]
            if free == 0:
                chunk += 1
            else:
                J[KEPT * M + chunk] |= free & -free
                count += 1
        new_rows += count
        new_levels += 1
        N[new_level_start + new_levels] = new_rows
    N[folded + SYS_ROWS] = new_rows
    N[folded + SYS_LEVELS] = new_levels
    N[folded + SYS_UNITS] = new_units
    new_unit = new_level_start + new_levels + 1
    place = col = np.int64(0)
    for chunk in range((rows + 7) >> 3):
        r = 8 * chunk
        stays = mask_of(J[KEPT * M + chunk])
        units = load_integers(N, row_unit + r)
        real = both(stays, at_least(units, splat_integer(0)))
        unstable = at_least(load_integers(J, KIND * M + r), splat_integer(least))
        J[PLACE * M + chunk] = place
        pack_store(J, KEPT_ROWS * M + place, count_up(r), stays)
        pack_store(N, new_unit + place, choose(unstable, units, splat_integer(-1)), stays)
        place += count_bits(J[KEPT * M + chunk])
        if N[system + SYS_SINGLE]:
            real = both(real, unstable)
            pack_store(J, OLD_COL * M + col, load_integers(N, row_unit + rows + r), real)
            col += count_bits(bits_of(real))
    return new_rows


@kernel
def level_bits(r, begin, end):
    """Which of the eight rows from ``r`` on are in ``begin : end``, as bits."""
    return (0xFF << max(begin - r, 0)) & (0xFF >> max(r + 8 - end, 0))


@kernel
def new_row(J, M, r):
    """The folded system's row for row ``r``; for one that is left out, that of the next."""
    return J[PLACE * M + (r >> 3)] + count_bits(J[KEPT * M + (r >> 3)] & ((1 << (r & 7)) - 1))


@kernel
def lay_out_folded(N, J, M, system, folded, least, settled):
    """Write the integer part of the system that keeps the rows of kind ``least`` or more, at ``folded``.

    J[OLD_COL] gives the old column of every new one. ``settled`` is the number of columns that are substituted, see
    `list_settled_columns`. Returns the new numbers of rows and columns.
    """
    rows, levels = N[system + SYS_ROWS], N[system + SYS_LEVELS]
    row_col = system + SYS_HEADER + levels + 1 + rows
    old_begin = row_col + rows + 1 + N[system + SYS_COLS]
    old_end = old_begin + N[system + SYS_COLS]
    new_rows = choose_rows(N, J, M, system, folded, least)
    new_level_start = folded + SYS_HEADER
    new_unit = new_level_start + N[folded + SYS_LEVELS] + 1
    new_row_col = new_unit + new_rows
    if N[system + SYS_SINGLE]:
        new_cols = place_single_columns(N, new_unit, new_rows)
    else:
        new_cols = place_columns(N, J, M, row_col, new_unit, new_rows)
    N[folded + SYS_SINGLE] = N[system + SYS_SINGLE]
    N[folded + SYS_COLS] = new_cols
    N[folded + SYS_FLOATS] = system_floats(new_rows, new_cols)
    N[folded + SYS_INTS] = system_ints(new_rows, new_cols, N[folded + SYS_LEVELS])
    col_begin = new_row_col + new_rows + 1 + new_cols
    col_end = col_begin + new_cols
    for level in range(N[folded + SYS_LEVELS]):
        level_end = N[new_level_start + level + 1]
        first, last = N[new_row_col + N[new_level_start + level]], N[new_row_col + level_end]
        for c in range(first, last, 8):
            store(N, col_begin + c, splat_integer(level_end))
    begin = end = reach = np.int64(-1)
    for c in range(new_cols):
        old = J[OLD_COL * M + c]
        if N[old_begin + old] != begin or N[old_end + old] != end:
            begin, end = N[old_begin + old], N[old_end + old]
            reach = substituted_reach(N, J, M, old_end, begin, end, settled)
            if reach < rows:
                reach = max(padded(new_row(J, M, reach)), N[col_begin + c])
            else:
                reach = new_rows
        N[col_end + c] = reach
    return new_rows, new_cols


@kernel
def substituted_reach(N, J, M, old_end, begin, end, settled):
    """Up to which old row a column that rows ``begin : end`` read is read once settled rows are substituted."""
    for p in range(settled):
        row = J[SETTLED_ROW * M + p]
        if row >= end:
            break
        if row >= begin:
            end = max(end, N[old_end + J[STABLE_COLS * M + p]])
    return end


@kernel
def place_single_columns(N, new_unit, new_rows):
    """The first column of every row and the row of every column, where every unit has one; returns their number."""
    new_row_col = new_unit + new_rows
    col_row = new_row_col + new_rows + 1
    cols = np.int64(0)
    for q in range(0, new_rows, 8):
        bits = bits_of(at_least(load_integers(N, new_unit + q), splat_integer(0))) & level_bits(q, q, new_rows)
        store(N, new_row_col + q, count_before(bits, cols))
        cols += count_bits(bits)
    N[new_row_col + new_rows] = cols
    c = np.int64(0)
    for q in range(0, new_rows, 8):
        bits = bits_of(at_least(load_integers(N, new_unit + q), splat_integer(0))) & level_bits(q, q, new_rows)
        pack_store(N, col_row + c, count_up(q), mask_of(bits))
        c += count_bits(bits)
    return cols


@kernel
def place_columns(N, J, M, row_col, new_unit, new_rows):
    """`place_single_columns` for units of any number of outputs; also J[OLD_COL], the old column of every new one."""
    new_row_col = new_unit + new_rows
    col_row = new_row_col + new_rows + 1
    cols = np.int64(0)
    for q in range(new_rows):
        N[new_row_col + q] = cols
        r = J[KEPT_ROWS * M + q]
        cols += N[row_col + r + 1] - N[row_col + r] if N[new_unit + q] >= 0 else 0
    N[new_row_col + new_rows] = cols
    for q in range(new_rows):
        old = N[row_col + J[KEPT_ROWS * M + q]] - N[new_row_col + q]
        for c in range(N[new_row_col + q], N[new_row_col + q + 1]):
            J[OLD_COL * M + c] = old + c
            N[col_row + c] = q
    return cols


@kernel
def carry_states(N, J, M, tables, system, folded, least):
    """After `fold`: move the state ranges in J to the rows of the folded system, hash the others' states into it."""
    rows = N[system + SYS_ROWS]
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    hash0, hash1 = N[system + SYS_HASH], N[system + SYS_HASH + 1]
    for chunk in range((rows + 7) >> 3):
        r = 8 * chunk
        unstable = at_least(load_integers(J, KIND * M + r), splat_integer(least))
        real = both(
            at_least(load_integers(N, row_unit + r), splat_integer(0)), is_below(count_up(r), splat_integer(rows))
        )
        settled = bits_of(without(real, unstable))
        while settled != 0:
            q = r + lowest_bit(settled)
            settled &= settled - 1
            state = tables.first_knot[N[row_unit + q]] + N[row_unit + q] + J[STATE_LOW * M + q]
            hash0 ^= tables.state_hash[2 * state]
            hash1 ^= tables.state_hash[2 * state + 1]
        stays, place = mask_of(J[KEPT * M + chunk]), J[PLACE * M + chunk]
        low, high = load_integers(J, STATE_LOW * M + r), load_integers(J, STATE_HIGH * M + r)
        pack_store(J, STATE_LOW * M + place, low, stays)
        pack_store(J, STATE_HIGH * M + place, high, stays)
    N[folded + SYS_HASH], N[folded + SYS_HASH + 1] = hash0, hash1
