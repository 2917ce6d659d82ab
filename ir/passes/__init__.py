"""From an imported network to its canonical form: the passes, in order.

`canonicalize` runs `PASSES` from top to bottom. Each keeps the level set; tests check that by evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mn_onnx.ir.certify import Certificate, certify
from mn_onnx.ir.network import Floats, Network
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.passes.fuse_affine import FUSE_AFFINE
from mn_onnx.ir.passes.merge_proportional import MERGE_PROPORTIONAL
from mn_onnx.ir.passes.recognise import RECOGNISE
from mn_onnx.ir.passes.refine import ToleranceNotReached, refine
from mn_onnx.ir.passes.strip_heads import STRIP_HEADS
from mn_onnx.ir.passes.subtract_level import SUBTRACT_LEVEL
from mn_onnx.ir.passes.tabulate import TABULATE
from mn_onnx.ir.passes.unused import REMOVE_UNUSED
from mn_onnx.ir.spec import CANONICAL, IMPORTED, verify

# Everything but the tables ...
LOWERING: tuple[Pass, ...] = (
    RECOGNISE,
    FUSE_AFFINE,
    MERGE_PROPORTIONAL,
    FUSE_AFFINE,  # rows over merged duplicates may have cancelled
    STRIP_HEADS,  # a head spelled with several units is one unit now
    SUBTRACT_LEVEL,
    REMOVE_UNUSED,
)
# ... and all of it. Refinement repeats the last pass.
PASSES: tuple[Pass, ...] = (*LOWERING, TABULATE)


@dataclass(frozen=True)
class Step:
    """One pass that ran: its name, whether it changed the network, and the number of units after it."""

    name: str
    modified: bool
    units: int


class PassFailed(ValueError):
    """A pass could not do its work, or left an invalid network. The message names it and the passes before it."""


@dataclass(frozen=True, eq=False)
class Canonical:
    """The canonical form of a level set ``{x in box | source(x) = level}``.

    ``network``: canonical; its level set 0 is that set, and it increases where ``source`` does. ``source``: the
    imported network. ``level``: the level asked for. ``lower``, ``upper``: the box, float64 [input_dim]; surrogates and
    their errors hold inside. ``sign``: -1 if ``network`` is the negated pre-activation of a decreasing head, else 1.
    ``heads``: names of the units whose monotone functions were inverted at the level, the outermost first: ``network``
    gives the pre-activation of the last of them. ``empty_reason``: why the level set is known to be empty, else "".
    ``steps``: the passes that ran.
    ``refined``: the proof that refinement ended with, None if no tolerance was asked for.
    """

    network: Network
    source: Network
    level: float
    lower: Floats
    upper: Floats
    sign: int
    heads: tuple[str, ...]
    empty_reason: str
    steps: tuple[Step, ...]
    refined: Certificate | None = None

    @cached_property
    def certificate(self) -> Certificate:
        """A proved bound on ``|f_true - f|`` on the box, computed when first asked for (up to a few seconds).

        ``f`` is the canonical network's value (the pre-activation of a stripped head); the error is zero for exact
        networks.
        """
        return self.refined or certify(self.network, self.lower, self.upper)

    @property
    def surrogate_eps(self) -> float:
        """The certificate's bound on ``|f_true - f|`` on the box."""
        return self.certificate.error

    @property
    def is_exact(self) -> bool:
        """Whether no unit was replaced by a surrogate."""
        return not any(unit.table is not None and unit.table.errors.any() for unit in self.network.units)


def run_passes(program: Program, passes: tuple[Pass, ...]) -> tuple[Program, tuple[Step, ...]]:
    """Run ``passes`` in order, verifying what each requires and ensures.

    Raises `PassFailed` naming the pass and those that ran before it; the ``ValueError`` of the pass (a function without
    bounds) is its cause.
    """
    steps: list[Step] = []
    held: set[object] = set()
    for step in passes:
        try:
            missing = [check for check in step.requires if check not in held]
            verify(program.network, missing, f"before the pass '{step.name}'")
            program, modified = step.run(program)
            if modified:
                held.clear()
            verify(program.network, step.ensures, f"after the pass '{step.name}'")
        except ValueError as fault:
            before = ", ".join(f"'{done.name}'" for done in steps) or "none"
            raise PassFailed(f"pass '{step.name}' failed (passes before it: {before}): {fault}") from fault
        held.update(step.requires if not modified else (), step.ensures)
        steps.append(Step(step.name, modified, len(program.network.units)))
    return program, tuple(steps)


def canonicalize(
    network: Network,
    *,
    lower: Floats,
    upper: Floats,
    level: float = 0.0,
    surrogate_tol: float | None = None,
    knots_per_period: float | None = None,
) -> Canonical:
    """The canonical form of ``{x in box | network(x) = level}``.

    ``lower``, ``upper``: the box, float64 [input_dim]. ``knots_per_period``: how finely surrogates follow smooth
    functions (knots on every two lobes of curvature; default 16). ``surrogate_tol``: refine them until the certified
    error of the canonical network's value on the box is at most this.

    Raises `InvalidNetwork` for a network against the grammar, ``ValueError`` for an invalid box or option,
    `PassFailed` if a unit's function jumps, is unbounded or undefined on its range (the unit is named), and
    `ToleranceNotReached` with the reason if ``surrogate_tol`` cannot be certified.
    """
    verify(network, IMPORTED, "as imported")
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not np.isfinite(level):
        raise ValueError(f"the level must be a finite number, not {level}")
    if knots_per_period is not None and not knots_per_period >= 1:
        raise ValueError(f"knots_per_period must be at least 1, not {knots_per_period}")
    if surrogate_tol is not None and not surrogate_tol > 0:
        raise ValueError(f"surrogate_tol must be positive, not {surrogate_tol}")
    program = Program(network, lower, upper, float(level))
    if knots_per_period is not None:
        program = replace(program, knots_per_period=float(knots_per_period))
    lowered, lowering_steps = run_passes(program, LOWERING)
    program, table_steps = run_passes(lowered, (TABULATE,))
    refined = None
    if surrogate_tol is not None:
        program, refined = refine(lowered, program, surrogate_tol)
    verify(program.network, CANONICAL, "as canonical")
    return Canonical(
        program.network,
        network,
        float(level),
        lower,
        upper,
        program.sign,
        program.heads,
        program.empty_reason,
        (*lowering_steps, *table_steps),
        refined,
    )


__all__ = [
    "LOWERING", "PASSES", "Canonical", "Pass", "PassFailed", "Program", "Step", "ToleranceNotReached", "canonicalize",
    "run_passes",
]  # fmt: skip
