"""What a pass is: a named step from one program to an equivalent one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mn_onnx.ir.network import Floats, Network
from mn_onnx.ir.spec import Property


@dataclass(frozen=True, eq=False)
class Program:
    """A network on its way to canonical form: the set ``{x in box | network(x) = level}``.

    ``lower``, ``upper``: the box, float64 [input_dim]. ``sign``: -1 if the output of ``network`` is the negated
    pre-activation of a decreasing head, else 1; ``network`` increases where the original does. ``heads``: names of the
    units whose functions were inverted at the level, the outermost first. ``empty_reason``: why the level set is known
    to be empty, "" if it is not known to be.
    ``knots_per_period``: how finely surrogates follow smooth functions.
    ``tolerances``: instead, the sup errors wanted of the functions of a surrogate group, where given.
    """

    network: Network
    lower: Floats
    upper: Floats
    level: float = 0.0
    sign: int = 1
    heads: tuple[str, ...] = ()
    empty_reason: str = ""
    knots_per_period: float = 16.0
    tolerances: Mapping[Any, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Pass:
    """``run`` maps a program to an equivalent one and says whether it changed anything.

    ``requires`` must hold of the network before, ``ensures`` holds after.
    """

    name: str
    run: Callable[[Program], tuple[Program, bool]]
    requires: tuple[Property, ...]
    ensures: tuple[Property, ...]
