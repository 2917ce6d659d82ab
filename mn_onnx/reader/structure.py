"""Whether a graph is well formed: every tensor written once, defined before use, without cycles, with legal nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter

import onnx

from mn_onnx.errors import Problem

NEWEST_OPSET = 28
"""The newest version of the standard operators whose definitions the lowerings were checked against."""

_EXPORT_AGAIN = "export the model again, and check it with onnx.checker.check_model"


def node_label(node: onnx.NodeProto) -> str:
    """How messages call a node: its name, or its first output where it has none."""
    return node.name or next((name for name in node.output if name), node.op_type)


def opset_versions(model: onnx.ModelProto) -> dict[str, int]:
    """The imported version of each operator domain; the standard domain is ``""``."""
    return {"" if entry.domain == "ai.onnx" else entry.domain: entry.version for entry in model.opset_import}


def opset_problems(model: onnx.ModelProto) -> list[Problem]:
    """What is wrong with the operator sets that the model imports."""
    problems = []
    version = opset_versions(model).get("")
    if version is None:
        reason = "the model does not say which version of the standard operators it uses (opset_import)"
        problems.append(Problem("", "", 0, reason, "export it again with an exporter that sets the opset version"))
    elif not 1 <= version <= NEWEST_OPSET:
        reason = f"opset {version} is not known; versions up to {NEWEST_OPSET} are"
        problems.append(Problem("", "", 0, reason, "export with an older opset_version, or update mn-onnx"))
    counts = Counter("" if entry.domain == "ai.onnx" else entry.domain for entry in model.opset_import)
    for domain in sorted(domain for domain, count in counts.items() if count > 1):
        same = {domain, "ai.onnx" if domain == "" else domain}
        found = sorted({entry.version for entry in model.opset_import if entry.domain in same})
        if len(found) > 1:
            reason = f"the operator set {domain or 'ai.onnx'!r} is imported in several versions: {found}"
            problems.append(Problem("", "", 0, reason, _EXPORT_AGAIN))
    return problems


def interface_problems(graph: onnx.GraphProto) -> list[Problem]:
    """Missing inputs, outputs or nodes of the main graph."""
    initialized = {tensor.name for tensor in graph.initializer}
    problems = []
    if not any(value.name not in initialized for value in graph.input):
        problems.append(
            Problem("", "", 0, "the graph has no inputs: it is a constant", "export with the points as an input")
        )
    if not graph.output:
        problems.append(Problem("", "", 0, "the graph has no outputs", "export the field as an output of the graph"))
    if not graph.node:
        problems.append(Problem("", "", 0, "the graph has no nodes", "export the network with its layers"))
    return problems


def sort_nodes(graph: onnx.GraphProto, opsets: Mapping[str, int], outer: frozenset[str] = frozenset()) -> list[Problem]:
    """Bring the nodes of ``graph``, and of the graphs inside them, into topological order, in place.

    ``outer``: names defined by the graphs around this one. Returns all problems: tensors written twice or nowhere,
    cycles, outputs that nothing writes. Graphs with problems keep their order.
    """
    problems = list(_repeated_names(graph, opsets))
    producer = {name: index for index, node in enumerate(graph.node) for name in node.output if name}
    given = {value.name for value in graph.input} | {tensor.name for tensor in graph.initializer} | outer
    visible = frozenset(given | producer.keys())
    for node in graph.node:
        for inner in inner_graphs(node):
            problems += sort_nodes(inner, opsets, visible)
    for node in graph.node:
        for name in sorted(set(_own_reads(node)) - visible):
            problems.append(_problem(node, opsets, f"its input {name!r} is defined nowhere"))
    for value in graph.output:
        if value.name not in visible:
            problems.append(Problem(value.name, "", 0, "this graph output is written by no node", _EXPORT_AGAIN))
    if problems:
        return problems
    order: TopologicalSorter[int] = TopologicalSorter()
    for index, node in enumerate(graph.node):
        order.add(index, *sorted({producer[name] for name in _reads(node) if name in producer}))
    try:
        positions = list(order.static_order())
    except CycleError as error:
        nodes = [graph.node[index] for index in error.args[1][:-1]]
        path = " -> ".join(f"{node_label(node)} ({node.op_type})" for node in nodes)
        return [_problem(nodes[0], opsets, f"the graph has a cycle: {path}")]
    if positions != sorted(positions) and any(_reads_later(graph, producer)):
        nodes = [graph.node[index] for index in positions]
        copies = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
        del graph.node[:]
        graph.node.extend(copies)
    return []


def node_problems(graph: onnx.GraphProto, model: onnx.ModelProto) -> list[Problem]:
    """Nodes whose attributes, or numbers of inputs and outputs, contradict the definition of their operator.

    Operators that the installed onnx package does not define are left to the lowering table. Nodes with graphs inside
    are checked through the nodes of those.
    """
    opsets = opset_versions(model)
    context = onnx.checker.C.CheckerContext()
    context.ir_version = min(model.ir_version, onnx.IR_VERSION)
    context.opset_imports = dict(opsets)
    problems = []
    for node in graph.node:
        inner = list(inner_graphs(node))
        for part in inner:
            problems += node_problems(part, model)
        domain = "" if node.domain == "ai.onnx" else node.domain
        version = opsets.get(domain)
        if version is None:
            reason = f"the model imports no version of the operator set {domain or 'ai.onnx'!r}"
            problems.append(_problem(node, opsets, reason))
        elif not inner and onnx.defs.has(node.op_type, domain=domain, max_inclusive_version=version):
            formals = onnx.defs.get_schema(node.op_type, version, domain).inputs
            if (
                formals
                and formals[-1].option == onnx.defs.OpSchema.FormalParameterOption.Variadic
                and not all(node.input[len(formals) - 1 :])
            ):
                reason = f"one of the inputs that {node.op_type} takes any number of has no name"
                problems.append(_problem(node, opsets, reason))
                continue
            try:
                onnx.checker.check_node(node, context)
            except onnx.checker.ValidationError as error:
                reason = f"it contradicts the definition of {node.op_type}: {str(error).splitlines()[0]}"
                problems.append(_problem(node, opsets, reason))
    return problems


def _problem(node: onnx.NodeProto, opsets: Mapping[str, int], reason: str) -> Problem:
    domain = "" if node.domain == "ai.onnx" else node.domain
    op = f"{domain}::{node.op_type}" if domain else node.op_type
    return Problem(node_label(node), op, opsets.get(domain, 0), reason, _EXPORT_AGAIN)


def _repeated_names(graph: onnx.GraphProto, opsets: Mapping[str, int]) -> Iterator[Problem]:
    for kind, names in (
        ("initializers", [tensor.name for tensor in graph.initializer]),
        ("graph inputs", [value.name for value in graph.input]),
        ("graph outputs", [value.name for value in graph.output]),
    ):
        for name, count in Counter(names).items():
            if count > 1:
                yield Problem(name, "", 0, f"{count} {kind} have this name", _EXPORT_AGAIN)
    written = {value.name for value in graph.input} | {tensor.name for tensor in graph.initializer}
    for node in graph.node:
        for name in filter(None, node.output):
            if name in written:
                yield _problem(node, opsets, f"it writes the tensor {name!r}, which is already defined")
            written.add(name)


def inner_graphs(node: onnx.NodeProto) -> Iterator[onnx.GraphProto]:
    """The graphs in the attributes of a node."""
    for attribute in node.attribute:
        if attribute.HasField("g"):
            yield attribute.g
        yield from attribute.graphs


def _own_reads(node: onnx.NodeProto) -> Iterable[str]:
    return filter(None, node.input)


def _reads(node: onnx.NodeProto) -> Iterator[str]:
    """The tensors a node reads, those that the graphs inside it take from around them included."""
    yield from _own_reads(node)
    for inner in inner_graphs(node):
        own = {value.name for value in inner.input} | {tensor.name for tensor in inner.initializer}
        own.update(name for part in inner.node for name in part.output)
        read = {name for part in inner.node for name in _reads(part)} | {value.name for value in inner.output}
        yield from sorted(read - own)


def _reads_later(graph: onnx.GraphProto, producer: Mapping[str, int]) -> Iterator[bool]:
    """For each node, whether it reads what a later node (or itself) writes."""
    for index, node in enumerate(graph.node):
        yield any(producer.get(name, -1) >= index for name in _reads(node))
