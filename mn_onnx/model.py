"""A loaded model: the network as imported, the canonical network of its level set, and the box."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mn_onnx.errors import ModelRefused, Problem, UsageError
from mn_onnx.importer import Imported, ImportOptions, import_network
from mn_onnx.ir.bounds import output_bounds
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Network
from mn_onnx.ir.passes import Canonical, PassFailed, ToleranceNotReached
from mn_onnx.ir.scalar import UndefinedFunction
from mn_onnx.options import DEFAULT_BOUNDS, bounds_from_metadata, box, output_and_channel
from mn_onnx.reader import ModelSource, ReadModel, read_model
from mn_onnx.sign import oriented, resolve_sign
from mn_onnx.surrogates import Fineness, canonical_within_budget

Floats = NDArray[np.float64]


class LoadOptions(TypedDict, total=False):
    """What to extract from a model; all have defaults.

    ``output``: name of the output, ``NAME:CHANNEL`` if it has several values per point.
    ``level``: value of the level set, 0.
    ``bounds``: the box: ``(low, high)``, or a pair for each axis; by default the entry ``bounds`` of the model's
    metadata, else [-1, 1] on every axis.
    ``bind``: values for the other inputs, by name: numbers or arrays of the input's shape.
    ``coordinates``: which columns of the input are the point, if it has more.
    ``surrogate_tol``: refine the surrogates of smooth activations until |f_true - f| is certified to be at most this.
    ``knots_per_period``: how finely surrogates follow smooth activations, if no tolerance is given.
    ``budget``: the most polygons that a smooth network may give, as far as foretold: without tolerance or knots the
    surrogates are as fine as it allows.
    ``sign``: ``positive-outside``, ``positive-inside``, or ``auto``: by the values at the corners of the box.
    """

    output: str | None
    level: float
    bounds: ArrayLike | None
    bind: Mapping[str, ArrayLike] | None
    coordinates: Sequence[int | str] | None
    surrogate_tol: float | None
    knots_per_period: float | None
    budget: float | None
    sign: str | None


@dataclass(frozen=True, eq=False)
class Model:
    """A network ready for extraction.

    ``read``: the ONNX model. ``imported``: what it computes, with the true activations, and how its inputs are fed.
    ``canonical``: the piecewise-linear network whose level set f = 0 is asked for. ``level``: the value of the original
    output there. ``lower``, ``upper``: float64 [dimension], the box. ``seconds``: time per phase. ``sign``:
    ``positive-outside`` or ``positive-inside``, where the output is larger; the canonical f grows outwards.
    ``bounds_from``: where the box is from, ``option``, ``metadata`` or ``default``. ``fineness``: of a smooth network,
    with the expected cost; None for an exact one.
    """

    read: ReadModel
    imported: Imported
    canonical: Canonical
    level: float
    lower: Floats
    upper: Floats
    seconds: Mapping[str, float]
    sign: str
    bounds_from: str
    fineness: Fineness | None

    @property
    def network(self) -> Network:
        """The canonical network."""
        return self.canonical.network

    @property
    def dimension(self) -> int:
        """The number of coordinates of a point."""
        return self.network.input_dim

    @property
    def exact(self) -> bool:
        """Whether the network is piecewise linear as it stands, so that no surrogate stands in for an activation."""
        return self.canonical.is_exact

    @property
    def surrogate_eps(self) -> float:
        """A proved bound on |f_true - f| in the box, of the canonical f; zero for exact networks."""
        return self.canonical.surrogate_eps

    @cached_property
    def output_range(self) -> tuple[float, float]:
        """Certified bounds of the canonical f in the box; the level set is empty if zero is not between them."""
        return output_bounds(self.network, self.lower, self.upper)

    @property
    def bounds(self) -> Floats:
        """The box as pairs, float64 [dimension, 2]."""
        return np.stack([self.lower, self.upper], axis=1)

    def evaluate(self, points: ArrayLike) -> Floats:
        """The original output, with its true activations, in float64.

        ``points``: [n, dimension]; returns float64 [n]. Raises ValueError for points of another dimension.
        """
        return evaluate(self.imported.network, np.asarray(points, np.float64), true_functions=True)


def load(source: ModelSource | ReadModel, **options: Unpack[LoadOptions]) -> Model:
    """Read an ONNX model and bring it into canonical form.

    ``source``: a path, the bytes of a file, or an `onnx.ModelProto`; or a model that `read_model` has read already.
    ``options``: see `LoadOptions`.

    Raises `UsageError` for wrong options and unreadable paths, `ModelRefused` with every reason if the model is damaged
    or holds what cannot be extracted, `TypeError` for options that there are not.
    """
    started = time.perf_counter()
    check_options(options)
    read = source if isinstance(source, ReadModel) else read_model(source)
    imported = import_network(read.model, **import_options(read, options))
    return canonical_model(read, imported, options, seconds=time.perf_counter() - started)


def check_options(options: LoadOptions) -> None:
    """Raise `TypeError` for options that there are not, and `UsageError` for numbers that make no sense."""
    if unknown := options.keys() - LoadOptions.__annotations__.keys():
        raise TypeError(f"unknown options {sorted(unknown)}; there are {sorted(LoadOptions.__annotations__)}")
    level, knots, tolerance = options.get("level", 0.0), options.get("knots_per_period"), options.get("surrogate_tol")
    if not np.isfinite(level):
        raise UsageError(f"the level {level} is not a finite number")
    if knots is not None and not 1 <= knots < np.inf:
        raise UsageError(f"knots_per_period must be at least 1, not {knots}")
    if tolerance is not None and not 0 < tolerance < np.inf:
        raise UsageError(f"surrogate_tol must be a positive number, not {tolerance}")
    budget = options.get("budget")
    if budget is not None and not budget >= 1:
        raise UsageError(f"budget must be at least 1 polygon, not {budget}")


def import_options(read: ReadModel, options: LoadOptions) -> ImportOptions:
    """What the importer must know of ``options``."""
    output, channel = output_and_channel(options.get("output"), [value.name for value in read.model.graph.output])
    return {
        "output": output,
        "channel": channel,
        "bind": options.get("bind"),
        "coordinates": options.get("coordinates"),
    }


def canonical_model(read: ReadModel, imported: Imported, options: LoadOptions, *, seconds: float) -> Model:
    """The model of ``imported``, in canonical form; ``seconds``: what importing took. Raises as `load`."""
    started = time.perf_counter()
    level, tolerance = float(options.get("level", 0.0)), options.get("surrogate_tol")
    bounds, bounds_from = options.get("bounds"), "option"
    if bounds is None:
        bounds, bounds_from = bounds_from_metadata(imported.metadata), "metadata"
    if bounds is None:
        bounds, bounds_from = DEFAULT_BOUNDS, "default"
    lower, upper = box(bounds, imported.input_dim)
    try:
        canonical, fineness = canonical_within_budget(
            imported.network,
            lower=lower,
            upper=upper,
            level=level,
            surrogate_tol=tolerance,
            knots_per_period=options.get("knots_per_period"),
            budget=options.get("budget"),
        )
    except PassFailed as error:
        remedy = (
            "choose smaller --bounds, or export the network with activations that are defined everywhere (a quotient "
            "such as sin(t)/t as sin(s)/s with s = sqrt(t*t + 1e-8))"
        )
        raise ModelRefused([Problem("", "", 0, str(error), remedy)]) from error
    except ToleranceNotReached as error:
        raise UsageError(f"--surrogate-tol {tolerance:g} cannot be certified: {error}") from error
    with np.errstate(over="ignore", invalid="ignore"):
        sign = resolve_sign(canonical, options.get("sign"))
    phases = {"import": seconds, "lower": time.perf_counter() - started}
    model = Model(read, imported, oriented(canonical, sign), level, lower, upper, phases, sign, bounds_from, fineness)
    if not canonical.empty_reason:
        _refuse_constants_and_overflow(model)
    return model


def _refuse_constants_and_overflow(model: Model) -> None:
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            low, high = model.output_range
    except UndefinedFunction:
        low = high = np.nan
    if low == high == 0.0:
        reason = f"the output is {model.level:g}, the level, everywhere in the box: there is no surface"
        raise ModelRefused([Problem("", "", 0, reason, "check the weights, or choose another --level or --output")])
    if not np.isfinite([low, high]).all():
        reason = "its values in the box may be too large for float64"
        raise ModelRefused([Problem("", "", 0, reason, "scale the weights down, or choose smaller --bounds")])
