"""The supported operators as a table for people, generated from the lowering table itself."""

from __future__ import annotations

from mn_onnx.lowering import LOWERINGS


def operator_table() -> str:
    """Markdown, one row per operator: domain, versions from which its definitions hold, and fidelity."""
    rows = [
        (domain or "ai.onnx", operator, ", ".join(str(entry.since) for entry in entries), entries[-1].fidelity)
        for (domain, operator), entries in LOWERINGS.items()
    ]
    lines = ["| domain | operator | since version | fidelity |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in sorted(rows))]) + "\n"
