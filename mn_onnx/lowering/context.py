"""Runs a graph on symbolic tensors, collecting every reason to refuse it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import onnx

from mn_onnx.errors import Problem
from mn_onnx.lowering.fold import fold
from mn_onnx.lowering.node import Node, OpaqueInput, UnsupportedNode, decode_attributes, read_tensor
from mn_onnx.lowering.table import Lowering, Refusal
from mn_onnx.reader.structure import node_label
from mn_onnx.symbolic import CONSTANT, Constant, Opaque, Tensor, TooLargeError, lower
from mn_onnx.symbolic.algebra import Algebra
from mn_onnx.symbolic.store import Store

GraphValue = Constant | Tensor | Opaque | list[Any]
Scope = dict[str, GraphValue]

STEP_LIMIT = 20_000
"""Most nodes of subgraphs that are run, counting every iteration of loops."""


class Context:
    """The state of one run: the store, the problems so far, and the values in scope.

    ``lowerings`` and ``refusals`` map ``(domain, operator)``; ``opsets`` maps domains to the imported versions.
    """

    def __init__(
        self,
        store: Store,
        opsets: Mapping[str, int],
        lowerings: Mapping[tuple[str, str], Sequence[Lowering]],
        refusals: Mapping[tuple[str, str], Refusal],
    ) -> None:
        self.store = store
        self.opsets = opsets
        self.problems: list[Problem] = []
        self.algebra = Algebra(store, self._report_by_label)
        self.traces: list[Trace] = []
        self._lowerings = lowerings
        self._refusals = refusals
        self._numbers: dict[tuple[str, str], int] = {}
        self._ops: dict[str, tuple[str, int]] = {}
        self._steps = 0
        self._scopes: list[Scope] = []

    # Problems

    def report(self, node: Node, reason: str, remedy: str) -> int:
        """Record a problem of a node and return its number; the same problem is recorded once."""
        return self._report_by_label(node.label, reason, remedy)

    def unknown(self, reason: str, remedy: str = "") -> Opaque:
        """An output that cannot be represented, of the node that is being lowered."""
        return Opaque(frozenset({self._report_by_label(self.algebra.node, reason, remedy)}))

    def _report_by_label(self, label: str, reason: str, remedy: str) -> int:
        key = (label, reason)
        if key not in self._numbers:
            self._numbers[key] = len(self.problems)
            self.problems.append(self.node_problem(label, reason, remedy))
        return self._numbers[key]

    def node_problem(self, label: str, reason: str, remedy: str) -> Problem:
        """A problem of the node or tensor with this label."""
        return Problem(label, *self._ops.get(label, ("", 0)), reason, remedy)

    # Running

    def run_graph(self, graph: onnx.GraphProto, inputs: Scope) -> list[GraphValue]:
        """The values of the outputs of a graph, which may read the enclosing graphs' tensors as well."""
        scope: Scope = dict(self._scopes[-1]) if self._scopes else {}
        scope.update({tensor.name: read_tensor(tensor) for tensor in graph.initializer})
        scope.update(inputs)
        self._scopes.append(scope)
        try:
            self._run_nodes(graph, scope)
        finally:
            self._scopes.pop()
        return [self._read(scope, output.name) for output in graph.output]

    def _run_nodes(self, graph: onnx.GraphProto, scope: Scope) -> None:
        """Run the nodes of a graph, dropping tensors after their last use."""
        pending = Counter(name for node in graph.node for name in reads(node))
        pending.update(output.name for output in graph.output)
        for proto in graph.node:
            label = node_label(proto)
            if len(self._scopes) > 1:
                self._count_step()
            for name, value in zip(proto.output, self._run_node(proto, scope, label), strict=False):
                if name:
                    scope[name] = value
            if len(self._scopes) == 1:
                self.traces.append(Trace.of(label, [scope[name] for name in proto.output if name in scope], self.store))
            for name in reads(proto):
                pending[name] -= 1
                if not pending[name]:
                    scope.pop(name, None)

    def _count_step(self) -> None:
        self._steps += 1
        if self._steps > STEP_LIMIT:
            raise UnsupportedNode(
                f"it runs more than {STEP_LIMIT} nodes, counting loop iterations",
                "export with fewer iterations, or without a loop over the points",
            )

    def _read(self, scope: Scope, name: str) -> GraphValue:
        value = scope.get(name)
        return self._missing(name) if value is None else value

    def _missing(self, name: str) -> Opaque:
        return Opaque(
            frozenset({self._report_by_label(name, "no node computes this tensor", "export the model again")})
        )

    def _run_node(self, proto: onnx.NodeProto, scope: Scope, label: str) -> Sequence[GraphValue]:
        domain = "" if proto.domain == "ai.onnx" else proto.domain
        inputs = [self._read(scope, name) if name else None for name in proto.input]
        while inputs and inputs[-1] is None:
            inputs.pop()
        version = self.opsets.get(domain, 0)
        self._ops[label] = (f"{domain}::{proto.op_type}" if domain else proto.op_type, version)
        self.algebra.node = label
        node = Node(proto, domain, version, label, inputs)
        try:
            node = replace(node, attributes=decode_attributes(proto))
            outputs = self._lower(node)
        except OpaqueInput as error:
            return self._opaque(node, error.problems)
        except UnsupportedNode as error:
            return self._opaque(node, frozenset({self.report(node, error.reason, error.remedy)}))
        except TooLargeError as error:
            return self._opaque(node, frozenset({self.report(node, str(error), "export with fewer points at once")}))
        except (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError) as error:
            reason = f"it cannot be evaluated: {error}"
            return self._opaque(node, frozenset({self.report(node, reason, "check the model with onnx.checker")}))
        values: list[GraphValue] = []
        for value in outputs if isinstance(outputs, tuple) else (outputs,):
            if isinstance(value, Tensor):
                self.store.name_elements(value, label)
                value = lower(value)
            values.append(value)
        return values

    def _lower(self, node: Node) -> Any:
        key = (node.domain, node.op)
        refusal = self._refusals.get(key)
        entry = self._entry(node)
        if entry is None and key in self._lowerings:
            raise self._unknown_operator(node)  # nor can constants be trusted to a definition that old
        if (entry is None or not entry.on_constants) and not (refusal and refusal.never_fold) and node.inputs:
            given = [value for value in node.inputs if value is not None]
            if all(isinstance(value, Constant) for value in given):
                return fold(node)
        if entry is not None:
            return entry.lower(self, node)
        if refusal is not None:
            raise UnsupportedNode(refusal.reason, refusal.remedy)
        raise self._unknown_operator(node)

    def _entry(self, node: Node) -> Lowering | None:
        entries = self._lowerings.get((node.domain, node.op), ())
        return max((e for e in entries if e.since <= node.version), key=lambda e: e.since, default=None)

    def _unknown_operator(self, node: Node) -> UnsupportedNode:
        entries = self._lowerings.get((node.domain, node.op), ())
        if entries:
            oldest = min(entry.since for entry in entries)
            return UnsupportedNode(
                f"its definition before version {oldest} is not supported",
                f"export with opset {max(oldest, 7)} or newer, or convert with onnx.version_converter",
            )
        if node.domain == "" and not onnx.defs.has(node.op, ""):
            return UnsupportedNode("there is no such operator in ONNX", "export with a newer exporter, or another one")
        if node.domain not in ("", "ai.onnx.ml"):
            return UnsupportedNode(
                "an operator outside the ONNX standard that is not supported",
                "export without custom operators and without runtime-specific optimisation",
            )
        return UnsupportedNode(
            "not supported on data that depend on the points",
            "export a network of affine layers and activations of single numbers",
        )

    def _opaque(self, node: Node, problems: frozenset[int]) -> list[GraphValue]:
        for value in node.inputs:
            problems |= self.problems_of(value)
        return [Opaque(problems) for _ in node.proto.output]

    def problems_of(self, value: GraphValue | None) -> frozenset[int]:
        """The numbers of the problems that keep a value from being known."""
        if isinstance(value, Opaque):
            return value.problems
        if isinstance(value, list):
            return frozenset().union(*(self.problems_of(item) for item in value))
        if isinstance(value, Tensor):
            refused = np.unique(value.base[value.base < CONSTANT])
            return frozenset().union(*(self.store.refusal_problems(base) for base in refused.tolist()))
        return frozenset()


class Trace:
    """What a node computed for the first and last point, to find the node where two runs or two points part."""

    def __init__(self, label: str, first: list[bytes], last: list[bytes], size: tuple[int, int, int, int]) -> None:
        self.label = label
        self.first = first
        self.last = last
        self.size = size

    @classmethod
    def of(cls, label: str, values: Iterable[GraphValue], store: Store) -> Trace:
        first: list[bytes] = []
        last: list[bytes] = []
        for value in values:
            if isinstance(value, Tensor):
                first.append(_signature(value, value.point == 0))
                last.append(_signature(value, value.point == value.point.max()))
        return cls(
            label, first, last, (len(store.directions), len(store.bases), len(store.functions), len(store.units))
        )


def _signature(value: Tensor, mask: np.ndarray) -> bytes:
    return b"".join(f[mask].tobytes() for f in (value.base, value.function, value.scale, value.offset))


def reads(node: onnx.NodeProto) -> Iterator[str]:
    """Names that a node reads, those inside its subgraphs included."""
    yield from (name for name in node.input if name)
    for attribute in node.attribute:
        graphs = [attribute.g] if attribute.type == onnx.AttributeProto.GRAPH else attribute.graphs
        for graph in graphs:
            for inner in graph.node:
                yield from reads(inner)
            yield from (output.name for output in graph.output)
