"""What a lowering sees of an ONNX node, and how it refuses one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper

from mn_onnx.symbolic import Constant, Opaque, Tensor, Value


class UnsupportedNode(Exception):
    """A node cannot be lowered; ``remedy`` says what the user can do."""

    def __init__(self, reason: str, remedy: str = "") -> None:
        super().__init__(reason)
        self.reason = reason
        self.remedy = remedy


class OpaqueInput(Exception):
    """A node reads a tensor that a refused node should have made; ``problems`` are the numbers of the reasons."""

    def __init__(self, problems: frozenset[int]) -> None:
        super().__init__()
        self.problems = problems


@dataclass(frozen=True, eq=False)
class Node:
    """An ONNX node with decoded attributes and the values of its inputs; absent optional inputs are None.

    ``domain`` is ``""`` for standard operators; ``version`` is the one the model imports of that domain.
    """

    proto: onnx.NodeProto
    domain: str
    version: int
    label: str
    inputs: Sequence[Value | list[Any] | None]
    attributes: dict[str, Any] = field(default_factory=dict)

    @property
    def op(self) -> str:
        return self.proto.op_type

    @property
    def n_outputs(self) -> int:
        return len(self.proto.output)

    def wants(self, output: int) -> bool:
        """Whether output number ``output`` is used by name."""
        return output < self.n_outputs and bool(self.proto.output[output])

    def has(self, index: int) -> bool:
        """Whether input number ``index`` is present."""
        return index < len(self.inputs) and self.inputs[index] is not None

    def tensor(self, index: int) -> Constant | Tensor:
        """Input ``index``, which must be present and a tensor."""
        if not self.has(index):
            raise UnsupportedNode(f"input {index} is missing")
        value = self.inputs[index]
        if isinstance(value, Opaque):
            raise OpaqueInput(value.problems)
        if not isinstance(value, (Constant, Tensor)):
            raise UnsupportedNode(f"input {index} is a sequence, not a tensor")
        return value

    def constant(self, index: int, what: str) -> np.ndarray:
        """The values of input ``index``, which must not depend on the points; ``what`` names it in messages."""
        value = self.tensor(index)
        if isinstance(value, Tensor):
            raise UnsupportedNode(
                f"its {what} depends on the points; only a constant {what} is supported",
                f"export the network with a constant {what}",
            )
        return value.array

    def optional(self, index: int, what: str) -> np.ndarray | None:
        """Like `constant`; None if the input is absent."""
        return self.constant(index, what) if self.has(index) else None

    def integers(self, index: int, attribute: str, what: str) -> list[int] | None:
        """A list that old versions hold in an attribute and newer ones in an input; None if in neither."""
        if self.has(index):
            return [int(value) for value in np.atleast_1d(self.constant(index, what))]
        values = self.attributes.get(attribute)
        return None if values is None else [int(value) for value in values]

    def attribute(self, name: str, default: Any = None) -> Any:
        return self.attributes.get(name, default)


def decode_attributes(proto: onnx.NodeProto) -> dict[str, Any]:
    """Attribute values by name: numbers, strings, lists, graphs, and tensors as `Constant`."""
    decoded: dict[str, Any] = {}
    for attribute in proto.attribute:
        value = onnx.helper.get_attribute_value(attribute)
        if attribute.type == onnx.AttributeProto.TENSOR:
            value = read_tensor(value)
        elif attribute.type == onnx.AttributeProto.STRING:
            value = value.decode("utf-8", "replace")
        elif attribute.type == onnx.AttributeProto.STRINGS:
            value = [item.decode("utf-8", "replace") for item in value]
        decoded[attribute.name] = value
    return decoded


def read_tensor(tensor: onnx.TensorProto) -> Constant:
    """The values of a stored tensor; packed 4-bit integers are widened to 8 bits."""
    array = numpy_helper.to_array(tensor)
    name = array.dtype.name
    if name in ("int4", "int2"):
        array = array.astype(np.int8)
    elif name in ("uint4", "uint2"):
        array = array.astype(np.uint8)
    return Constant.of(array)
