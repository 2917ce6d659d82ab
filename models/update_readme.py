"""Write the generated tables of the README: which operators are supported, and what the networks here measure.

python models/update_readme.py operators
python models/update_readme.py measurements
"""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Callable
from pathlib import Path

import mn_onnx
from mn_onnx.operators import operator_table

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
MEASURED = ("bunny_relu_d3_w128", "bunny_relu_d4_w128", "am_chair", "niq_fox")


def measurement_table() -> str:
    """Extract the ReLU networks of this folder, and tabulate counts, residuals and times."""
    lines = [
        f"mn-onnx {mn_onnx.__version__} on {os.cpu_count()} cores ({platform.machine()}), box [-1, 1]^3.",
        "",
        "| network | polygons | vertices | components | Euler | max abs(f) | traverse, s | weld, s | per polygon, us |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in MEASURED:
        report = mn_onnx.extract(ROOT / "models" / f"{name}.onnx").report
        seconds = report["seconds"]
        pace = 1e6 * (seconds["traverse"] + seconds["weld"]) / report["polygons"]
        lines.append(
            f"| `{name}` | {report['polygons']:,} | {report['vertices']:,} | {report['components']} "
            f"| {report['euler']} | {report['max_abs_f']:.1e} "
            f"| {seconds['traverse']:.2f} | {seconds['weld']:.2f} | {pace:.1f} |"
        )
    return "\n".join(lines)


TABLES: dict[str, Callable[[], str]] = {"operators": operator_table, "measurements": measurement_table}


def with_table(text: str, name: str, table: str) -> str:
    """``text`` with ``table`` in place of what stands between the marks of ``name``."""
    pattern = re.compile(rf"(<!-- generated: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    updated, count = pattern.subn(lambda match: f"{match[1]}\n{table}\n\n{match[2]}", text)
    if count != 1:
        sys.exit(f"{README} has {count} places for the table {name}, expected one")
    return updated


def main() -> None:
    """Update the tables named on the command line."""
    if len(sys.argv) < 2 or not set(sys.argv[1:]) <= TABLES.keys():
        sys.exit(f"usage: python models/update_readme.py {' | '.join(TABLES)}")
    for name in sys.argv[1:]:
        README.write_text(with_table(README.read_text(), name, TABLES[name]()))


if __name__ == "__main__":
    main()
