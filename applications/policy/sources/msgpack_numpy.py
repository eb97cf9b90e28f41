"""Messages of openpi: msgpack with arrays of numpy, as `openpi_client.msgpack_numpy` 0.1.2 writes them.

An array is a map of b"__ndarray__", b"data", b"dtype" and b"shape", a scalar one of b"__npgeneric__", b"data" and
b"dtype". Only numbers are read: no objects, no pickles, no structures. Whatever a message declares, reading it takes at
most a fixed multiple of its length.
"""

from __future__ import annotations

import math
import re
from typing import Any

import msgpack
import numpy as np

MAX_BYTES = 1024 * 1024  # of a message that is read: 1000 rows of 100 columns, or 0.1 s of reading at most
_MAX_ITEMS = 10_000  # of a list or a map
_MAX_CONTAINERS = 2_000  # lists and maps in a message
_MAX_DIMENSIONS = 8
_DTYPES = re.compile(r"[<>|=]?(?:[iu][1248]|f[248]|b1)")


class WrongMessage(ValueError):
    """Bytes that are no message of numbers, texts, lists and maps."""


def pack(message: dict[str, Any]) -> bytes:
    """Return the bytes of a message."""
    return bytes(msgpack.packb(message, default=_packed))


def unpack(data: bytes) -> Any:
    """Return the message of bytes; its arrays are read-only.

    Raises:
        WrongMessage: they are none, it is too large, or an array is inconsistent or not of numbers.
    """
    if len(data) > MAX_BYTES:
        raise WrongMessage(f"{len(data)} bytes are more than {MAX_BYTES}")
    containers = 0

    def count() -> None:
        nonlocal containers
        containers += 1
        if containers > _MAX_CONTAINERS:
            raise WrongMessage(f"more than {_MAX_CONTAINERS} lists and maps")

    def of_map(found: dict[Any, Any]) -> Any:
        count()
        return _array(found)

    def of_list(found: list[Any]) -> list[Any]:
        count()
        return found

    try:
        return msgpack.unpackb(
            data, object_hook=of_map, list_hook=of_list, max_array_len=_MAX_ITEMS, max_map_len=_MAX_ITEMS,
            max_ext_len=0, max_str_len=MAX_BYTES, max_bin_len=MAX_BYTES)
    except WrongMessage:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, MemoryError, msgpack.UnpackException) as error:
        reason = " ".join((str(error) or type(error).__name__).split())
        raise WrongMessage(f"no msgpack of openpi: {reason[:200]}") from None


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _array(found: dict[Any, Any]) -> Any:
    """Return the array or scalar that a map describes; any other map as it is."""
    if b"__ndarray__" in found:
        data, shape, dtype = found.get(b"data"), found.get(b"shape"), _dtype(found.get(b"dtype"))
        if not isinstance(data, bytes):
            raise WrongMessage(f"the data of an array are {type(data).__name__}, not bytes")
        if not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS or not all(
                type(size) is int and 0 <= size <= MAX_BYTES for size in shape):
            raise WrongMessage("the shape of an array is no list of at most 8 sizes")
        if math.prod(shape) * dtype.itemsize != len(data):
            raise WrongMessage(f"an array of shape ({', '.join(map(str, shape))}) of {dtype} has {len(data)} bytes of "
                               "data")
        return np.frombuffer(data, dtype).reshape(shape)
    if b"__npgeneric__" in found:
        value, dtype = found.get(b"data"), _dtype(found.get(b"dtype"))
        if not isinstance(value, bool | int | float):
            raise WrongMessage(f"a scalar is {type(value).__name__}, not a number")
        with np.errstate(over="ignore"):
            return dtype.type(value)
    return found


def _dtype(name: object) -> np.dtype[Any]:
    if isinstance(name, bytes):
        name = name[:20].decode("ascii", "replace")
    if not isinstance(name, str) or _DTYPES.fullmatch(name) is None:
        raise WrongMessage(f"an array of type {str(name)[:40]!r} is refused; numbers are read only")
    return np.dtype(name)
