"""Writes small ONNX files with protobuf's wire format, so that tests need no package for it.

Field numbers are those of onnx.proto (ONNX 1.16).
"""

from collections.abc import Sequence

import numpy as np


def _varint(value: int) -> bytes:
    found = bytearray()
    while True:
        value, low = value >> 7, value & 0x7F
        found.append(low | (0x80 if value else 0))
        if not value:
            return bytes(found)


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def tensor(name: str, values: np.ndarray) -> bytes:
    kind = {"f": 1, "i": 7}[values.dtype.kind]  # FLOAT, INT64
    data = values.astype(np.float32 if kind == 1 else np.int64).tobytes()
    return b"".join(_field(1, size) for size in values.shape) + _field(2, kind) + _field(8, name) + _field(9, data)


def node(kind: str, inputs: Sequence[str], output: str) -> bytes:
    return b"".join(_field(1, each) for each in inputs) + _field(2, output) + _field(3, output) + _field(4, kind)


def value(name: str, shape: Sequence[int]) -> bytes:
    dimensions = b"".join(_field(1, _field(1, size)) for size in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, dimensions)))


def model(
    nodes: Sequence[bytes], constants: Sequence[bytes], inputs: Sequence[bytes], outputs: Sequence[bytes],
) -> bytes:
    graph = b"".join(
        [*(_field(1, each) for each in nodes), _field(2, "policy"), *(_field(5, each) for each in constants),
         *(_field(11, each) for each in inputs), *(_field(12, each) for each in outputs)])
    return _field(1, 8) + _field(7, graph) + _field(8, _field(1, "") + _field(2, 13))


def linear_policy(
    weights: np.ndarray, bias: np.ndarray, rows: int, *, cameras: Sequence[str] = (), size: tuple[int, int] = (32, 24),
) -> bytes:
    """A network `state @ weights + bias`, plus the mean of each image in every column; output `actions`."""
    columns = len(bias) // rows
    nodes = [node("MatMul", ["state", "weights"], "product"), node("Add", ["product", "bias"], "sum")]
    before = "sum"
    for camera in cameras:
        nodes += [node("GlobalAveragePool", [camera], f"{camera}_mean"),
                  node("Flatten", [f"{camera}_mean"], f"{camera}_row"),
                  node("MatMul", [f"{camera}_row", "spread"], f"{camera}_spread"),
                  node("Add", [before, f"{camera}_spread"], f"{camera}_sum")]
        before = f"{camera}_sum"
    nodes.append(node("Reshape", [before, "shape"], "actions"))
    constants = [tensor("weights", weights), tensor("bias", bias[None]), tensor("shape", np.array([1, rows, columns]))]
    if cameras:
        constants.append(tensor("spread", np.full((3, len(bias)), 1 / 3)))
    inputs = [value("state", (1, len(weights))), *(value(name, (1, 3, size[1], size[0])) for name in cameras)]
    return model(nodes, constants, inputs, [value("actions", (1, rows, columns))])
