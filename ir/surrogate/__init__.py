"""Piecewise-linear surrogates of smooth scalar functions, with proved errors."""

from mn_onnx.ir.surrogate.curvature import BendProfile, bend_profile, kinks, require_bounded
from mn_onnx.ir.surrogate.fit import error_of_knots, fit

__all__ = ["BendProfile", "bend_profile", "error_of_knots", "fit", "kinks", "require_bounded"]
