"""Model-local functions, put in place of the nodes that call them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import onnx
import onnx.inliner

from mn_onnx.reader.structure import inner_graphs

Key = tuple[str, str, str]
"""The domain, name and overload of a function."""


def inline_functions(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model without model-local functions. Raises what onnx's inliner raises on functions it cannot inline.

    That one leaves out the defaults of a function's attributes, so they are written to the nodes that call it before.
    """
    complete = onnx.ModelProto()
    complete.CopyFrom(model)
    defaults = {
        (function.domain, function.name, function.overload): function.attribute_proto for function in complete.functions
    }
    _write_defaults(complete.graph.node, defaults)
    for function in complete.functions:
        _write_defaults(function.node, defaults)
    return onnx.inliner.inline_local_functions(complete, convert_version=True)


def _write_defaults(nodes: Iterable[onnx.NodeProto], defaults: Mapping[Key, Iterable[onnx.AttributeProto]]) -> None:
    for node in nodes:
        given = {attribute.name for attribute in node.attribute}
        missing = defaults.get((node.domain, node.op_type, node.overload), ())
        node.attribute.extend(attribute for attribute in missing if attribute.name not in given)
        for inner in inner_graphs(node):
            _write_defaults(inner.node, defaults)
