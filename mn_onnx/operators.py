"""The table of supported operators, made from the lowering table."""

from __future__ import annotations

from mn_onnx.lowering import LOWERINGS

_DOMAINS = {"": "ai.onnx"}


def operator_table() -> str:
    """A Markdown table: per operator domain and fidelity, the operators with the version their lowering starts from."""
    groups: dict[tuple[str, str], list[str]] = {}
    for (domain, operator), entries in sorted(LOWERINGS.items()):
        fidelities = {entry.fidelity for entry in entries}
        fidelity = "surrogate" if "surrogate" in fidelities else "exact"
        since = min(entry.since for entry in entries)
        groups.setdefault((domain, fidelity), []).append(f"{operator} {since}" if since > 1 else operator)
    lines = ["| operator set | fidelity | operators (with the first version, where it is not 1) |", "|---|---|---|"]
    lines += [
        f"| {_DOMAINS.get(domain, domain)} | {fidelity} | {', '.join(names)} |"
        for (domain, fidelity), names in sorted(groups.items())
    ]
    return "\n".join(lines)
