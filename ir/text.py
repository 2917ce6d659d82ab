"""Networks as text that a person can read."""

from __future__ import annotations

from collections.abc import Iterator

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.levels import level_blocks
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit

INFIX = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/", "power": "**", "less": "<", "less_equal": "<=",
         "equal": "=="}  # fmt: skip
MOST_TERMS = 6
MOST_PIECES = 8


def expression_text(expression: Expression) -> str:
    """``expression`` as a formula in ``t``."""
    if expression.op == "t":
        return "t"
    if expression.op == "constant":
        return f"{expression.value:.6g}"
    arguments = [expression_text(argument) for argument in expression.arguments]
    if expression.op in INFIX:
        return f"({arguments[0]} {INFIX[expression.op]} {arguments[1]})"
    return f"{expression.op}({', '.join(arguments)})"


def variable_names(network: Network) -> list[str]:
    """``x0``.. for the inputs, ``u3`` for the output of unit 3, ``u3.1`` for its second output of several."""
    names = [f"x{axis}" for axis in range(network.input_dim)]
    for index, unit in enumerate(network.units):
        if unit.n_outputs == 1:
            names.append(f"u{index}")
        else:
            names.extend(f"u{index}.{output}" for output in range(unit.n_outputs))
    return names


def row_text(row: AffineRow, names: list[str], *, full: bool = False) -> str:
    """``row`` as a sum; unless ``full``, its middle is left out where it is long."""
    terms = [f"{weight:+.6g} {names[column]}" for column, weight in zip(row.columns, row.weights, strict=True)]
    if not full and len(terms) > MOST_TERMS:
        terms = [*terms[: MOST_TERMS - 1], f"... ({len(terms) - MOST_TERMS} more)", terms[-1]]
    return " ".join([f"{row.bias:.6g}", *terms])


def table_text(table: KnotTable, output: int, *, full: bool = False) -> str:
    """One output of ``table``, piece by piece; unless ``full``, a summary where it has many."""
    error = f", error <= {table.errors[output].max():.3g}" if table.errors[output].any() else ""
    if not full and table.knots.size >= MOST_PIECES:
        return f"{table.knots.size} knots in [{table.knots[0]:.6g}, {table.knots[-1]:.6g}]{error}"
    if not table.knots.size:
        return f"{_piece(table, output, 0)}{error}"
    parts = [f"{_piece(table, output, 0)} | t < {table.knots[0]:.6g}"]
    parts.extend(f"{_piece(table, output, i + 1)} | t >= {knot:.6g}" for i, knot in enumerate(table.knots))
    return "; ".join(parts) + error


def _piece(table: KnotTable, output: int, interval: int) -> str:
    slope, intercept = table.slopes[output, interval], table.intercepts[output, interval]
    if slope == 0:
        return f"{intercept:.6g}"
    line = "t" if slope == 1 else f"{slope:.6g} t"
    return line if intercept == 0 else f"{line} {intercept:+.6g}"


def _function_lines(unit: Unit, names: list[str], first: int, full: bool) -> Iterator[str]:
    for output, function in enumerate(unit.functions):
        name = names[first + output]
        if isinstance(function, Expression):
            yield f"      {name} = {expression_text(function)}"
            if unit.table is not None:
                yield f"      {name} ~ {table_text(unit.table, output, full=full)}"
        else:
            yield f"      {name} = {table_text(function, 0, full=full)}"


def dump(network: Network, *, full: bool = False) -> str:
    """``network`` as text: levels, units with their rows and functions, and the output.

    Long rows and tables are shortened unless ``full``.
    """
    names = variable_names(network)
    knots = sum(unit.table.knots.size for unit in network.units if unit.table is not None)
    weights = sum(unit.row.weights.size for unit in network.units) + network.output.weights.size
    lines = [
        f"network of {network.input_dim} inputs, {len(network.units)} units, {knots} knots, {weights} weights",
        *(f"  {key}: {value}" for key, value in network.metadata.items()),
    ]
    for level, block in enumerate(level_blocks(network)):
        lines.append(f"  level {level}: {block.units.size} units over {block.columns.size} variables")
        for index in block.units.tolist():
            unit = network.units[index]
            lines.append(f"    u{index} '{unit.name}': t = {row_text(unit.row, names, full=full)}")
            lines.extend(_function_lines(unit, names, int(network.first_variable[index]), full))
    lines.append(f"  output '{network.output_name}' = {row_text(network.output, names, full=full)}")
    return "\n".join(lines)
