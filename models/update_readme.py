"""Write the generated tables of the README: which operators are supported, and what the networks here measure.

python models/update_readme.py operators
python models/update_readme.py measurements (on a machine with nothing else to do; needs the extra `bench`)
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

from mn_onnx.bench import run_bench
from mn_onnx.bench.table import markdown
from mn_onnx.operators import operator_table

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
MEASURED = ("bunny_relu_d3_w128", "bunny_relu_d4_w128", "am_chair", "niq_fox")


def measurement_table() -> str:
    """Measure the ReLU networks of this folder against marching cubes."""
    result = run_bench([ROOT / "models" / f"{name}.onnx" for name in MEASURED], on_start=print)
    failures = [f"{model.model}: {failure}" for model in result.models for failure in model.failures]
    if failures:
        sys.exit("\n".join(failures))
    return markdown(result)


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
        table = TABLES[name]()  # takes minutes: the README is read after
        README.write_text(with_table(README.read_text(), name, table))


if __name__ == "__main__":
    main()
