"""What commands say of a mesh, a curve or roots on standard output: a few lines from a report."""

from __future__ import annotations

from typing import Any


def box_text(report: dict[str, Any]) -> str:
    """The box of a report, and where it is from."""
    source = {"option": "as asked for", "metadata": "from the model's metadata", "default": "by default"}
    sides = " x ".join(f"[{low:g}, {high:g}]" for low, high in report["bounds"])
    return f"{sides}, {source[report['bounds_from']]}"


def mesh_summary(mesh: str, report: dict[str, Any]) -> str:
    """A few lines about the mesh in the file ``mesh``, from the entries of `mn_onnx.report`."""
    lines = [
        f"{mesh}: {report['polygons']:,} polygons, {report['vertices']:,} vertices, {report['components']} components, "
        f"Euler number {report['euler']}, {_closure(report)}"
    ]
    if "bounds" in report:
        lines.append(f"  box: {box_text(report)}")
    if report["max_abs_f"] is not None:
        lines.append(
            f"  |f| at {report['residual_points']:,} points of the mesh: max {report['max_abs_f']:.2g}, "
            f"mean {report['mean_abs_f']:.2g}"
        )
    if not report["exact"]:
        lines.append(_surrogate_line(report))
    if report.get("surface_eps") is not None:
        lines.append(f"  on the mesh |f_true| is {_certificate(report)}")
    if report.get("polish") is not None:
        lines.append(_polish_line(report["polish"]))
        lines.append(f"  on the polished mesh |f_true| is {_certificate(report['polish'])}")
    if report["parity_runtime"] is not None:
        lines.append(
            f"  {report['parity_runtime']}: differs by {report['parity_max_abs_err']:.2g} "
            f"({report['parity_allowed_err']:.2g} allowed)"
            + ("" if report["ort_mean_abs_f"] is None else f", mean |f - level| {report['ort_mean_abs_f']:.2g}")
        )
    if "seconds" in report:
        lines.append("  " + ", ".join(f"{phase} {seconds:.2f} s" for phase, seconds in report["seconds"].items()))
    lines += [f"  note: {note}" for note in report["notes"]]
    return "\n".join(lines)


def planar_summary(path: str, report: dict[str, Any]) -> str:
    """A few lines about the curve or roots in the file ``path``, from the report of a `PlanarLevelSet`."""
    if "roots" in report:
        what = f"{report['roots']:,} roots"
    else:
        closure = "closed" if report["closed"] else "open where it leaves the box"
        what = (
            f"{report['polylines']:,} polylines of {report['segments']:,} segments, length {report['length']:.6g}, "
            f"{closure}"
        )
    lines = [f"{path}: {what}; max |f| {report['max_abs_f']:.2g}", f"  box: {box_text(report)}"]
    if not report["exact"]:
        lines.append(_surrogate_bound(report))
    return "\n".join(lines)


def _closure(report: dict[str, Any]) -> str:
    if report["unmatched_edges"]:
        return f"{report['unmatched_edges']:,} edges without neighbour"
    return "closed but for where it leaves the box" if report["boundary_edges"] else "closed"


def _surrogate_line(report: dict[str, Any]) -> str:
    line = _surrogate_bound(report)
    if report["true_mean_abs_f"] is None:
        return line
    return f"{line}; |output - level| on the mesh is {report['true_mean_abs_f']:.2g} in the mean"


def _surrogate_bound(report: dict[str, Any]) -> str:
    before = f" before {report['heads'][-1]}" if report["heads"] else ""
    return f"  surrogates within {report['surrogate_eps']:.2g} of the true network{before}"


def _certificate(entries: dict[str, Any]) -> str:
    return (
        f"certified at most {entries['surface_eps']:.2g} (median {entries['surface_eps_median']:.2g}); to first order "
        f"the true surface is within {entries['displacement']:.2g} (median {entries['displacement_median']:.2g})"
    )


def _polish_line(polish: dict[str, Any]) -> str:
    counts = (
        ("divided_polygons", "polygons divided to come closer"),
        ("held_vertices", "vertices held back so that no face turns over"),
        ("stray_vertices", "vertices found no root in reach"),
        ("reversed_polygons", "polygons face against the true gradient, parts of some that did before"),
    )
    told = "".join(f"; {polish[key]:,} {what}" for key, what in counts if polish[key])
    return (
        f"  polished: mean |f_true| at vertices {polish['mean_abs_f_before']:.2g} before, {polish['mean_abs_f']:.2g} "
        f"after (max {polish['max_abs_f']:.2g}), on faces {polish['true_mean_abs_f_before']:.2g} before, "
        f"{polish['true_mean_abs_f']:.2g} after; moved by up to {polish['largest_move']:.2g}{told}"
    )
