"""Lowering of Einsum to transpositions, sums and matrix products."""

from __future__ import annotations

import math
import string
from collections import Counter

import numpy as np

from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Tensor, rearrange
from mn_onnx.symbolic.linear import matmul

Operand = tuple[str, Constant | Tensor]
"""One letter per axis, and the tensor."""


def einsum(context: Context, node: Node) -> Constant | Tensor:
    """Einsum, two operands at a time."""
    tensors = [node.tensor(index) for index in range(len(node.inputs))]
    terms, output = parse(str(node.attribute("equation", "")), [len(tensor.shape) for tensor in tensors])
    operands = [diagonal(term, tensor) for term, tensor in zip(terms, tensors, strict=True)]
    while len(operands) > 1:
        needed = set(output).union(*(labels for labels, _ in operands[2:]))
        operands = [product(context, operands[0], operands[1], needed), *operands[2:]]
    labels, result = drop(context, operands[0], set(output))
    order = [labels.index(label) for label in output]
    return rearrange(result, lambda array: np.transpose(array, order))


def parse(equation: str, ranks: list[int]) -> tuple[list[str], str]:
    """The letters of each operand and of the output, with an ellipsis replaced by capital or unused letters."""
    left, arrow, right = equation.replace(" ", "").partition("->")
    terms = left.split(",")
    if len(terms) != len(ranks):
        raise UnsupportedNode(f"equation {equation!r} does not fit {len(ranks)} operands")
    widest = max(
        (rank - len(t.replace("...", "")) for t, rank in zip(terms, ranks, strict=True) if "..." in t), default=0
    )
    if not arrow:
        counts = Counter(left.replace(",", "").replace(".", ""))
        right = ("..." if "..." in left else "") + "".join(sorted(c for c, n in counts.items() if n == 1))
    free = "".join(letter for letter in string.ascii_letters if letter not in equation)[:widest]
    spread = []
    for term, rank in zip(terms, ranks, strict=True):
        width = rank - len(term.replace("...", ""))
        if width < 0 or (width and "..." not in term):
            raise UnsupportedNode(f"equation {equation!r} does not fit an operand of {rank} axes")
        spread.append(term.replace("...", free[len(free) - width :]))
    return spread, right.replace("...", free)


def diagonal(labels: str, tensor: Constant | Tensor) -> Operand:
    """Take the diagonal over letters that repeat within one operand."""
    unique = "".join(dict.fromkeys(labels))
    if unique == labels:
        return labels, tensor
    codes = [string.ascii_letters.index(label) for label in labels]
    return unique, rearrange(tensor, lambda array: np.einsum(array, codes, [codes[labels.index(c)] for c in unique]))


def drop(context: Context, operand: Operand, needed: set[str]) -> Operand:
    """Sum over the letters that are not needed any more."""
    labels, tensor = operand
    kept = "".join(label for label in labels if label in needed)
    if kept == labels:
        return operand
    gone = [label for label in labels if label not in needed]
    order = [labels.index(label) for label in (*kept, *gone)]
    shape = [tensor.shape[labels.index(label)] for label in kept]
    count = math.prod(tensor.shape[labels.index(label)] for label in gone)
    rows = rearrange(tensor, lambda array: np.transpose(array, order).reshape(-1, count))
    total = matmul(context.algebra, rows, Constant.of(np.ones((count, 1))))
    return kept, rearrange(total, lambda array: array.reshape(shape))


def product(context: Context, x: Operand, y: Operand, needed: set[str]) -> Operand:
    """The product of two operands as a batched matrix product, summed over the letters not ``needed``."""
    (x_labels, x_tensor), (y_labels, y_tensor) = (
        drop(context, x, needed | set(y[0])),
        drop(context, y, needed | set(x[0])),
    )
    sizes: dict[str, int] = {}
    for labels, tensor in ((x_labels, x_tensor), (y_labels, y_tensor)):
        for label, size in zip(labels, tensor.shape, strict=True):
            if 1 not in (size, sizes.setdefault(label, size)) and sizes[label] != size:
                raise UnsupportedNode(f"axis {label!r} has sizes {sizes[label]} and {size}")
            sizes[label] = max(sizes[label], size)
    shared = [label for label in x_labels if label in y_labels]
    batch = [label for label in shared if label in needed]
    summed = [label for label in shared if label not in needed]
    rows = [label for label in x_labels if label not in shared]
    columns = [label for label in y_labels if label not in shared]

    def arranged(labels: str, tensor: Constant | Tensor, *parts: list[str]) -> Constant | Tensor:
        order = [labels.index(label) for part in parts for label in part]
        full = [sizes[label] for part in parts for label in part]
        shape = [math.prod(sizes[label] for label in part) for part in parts]
        return rearrange(tensor, lambda a: np.broadcast_to(np.transpose(a, order), full).reshape(shape))

    left = arranged(x_labels, x_tensor, batch, rows, summed)
    right = arranged(y_labels, y_tensor, batch, summed, columns)
    result = matmul(context.algebra, left, right)
    labels = "".join((*batch, *rows, *columns))
    return labels, rearrange(result, lambda array: array.reshape([sizes[label] for label in labels]))


LOWERINGS: Table = {"Einsum": same(einsum, 12, on_constants=True)}
