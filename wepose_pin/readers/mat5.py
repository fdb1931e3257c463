"""MATLAB's files of level 5, as it saves them since 1996 but for v7.3: arrays of numbers by their path, no more.

Read here and not by SciPy, whose reader dies with the whole process on some damaged files (seen with SciPy 1.17), and
unpacks whatever a file says it holds. Source: MathWorks, "MAT-File Format", chapter on level 5.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

HEADER = 128  # [bytes]
DEEPEST = 32  # structs within each other
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_STRUCT, _FIRST_NUMERIC, _LAST_NUMERIC = 2, 6, 15
_COMPLEX = 0x0800


class _Element(NamedTuple):
    kind: int
    data: memoryview


def is_level_5(start: bytes) -> bool:
    """Return whether a file's first 128 bytes are those of such a file."""
    return len(start) >= HEADER and start[126:128] in (b"IM", b"MI") and start[124:126] in (b"\0\1", b"\1\0")


def read_mat5(path: Path, most: int) -> dict[str, np.ndarray]:
    """Path → array (n,) or (n, k) of its own kind of numbers, without sides of length one; structs' fields are parts.

    A single number is an array without sides, ().

    What is neither a number nor a struct of one element is passed over.

    Raises
    ------
    ValueError
        Damaged, cut off, or it unpacks to more than `most` bytes.
    """
    content = path.read_bytes()
    order = "<" if content[126:128] == b"IM" else ">"
    arrays: dict[str, np.ndarray] = {}
    for element in _elements(memoryview(content)[HEADER:], order):
        inner = element
        if element.kind == _COMPRESSED:
            unpacked = _unpacked(element.data, most)
            most -= len(unpacked)
            inner = next(_elements(memoryview(unpacked), order), _Element(0, element.data[:0]))
        if inner.kind == _MATRIX:
            _walk("", inner.data, order, arrays, 0)
    return arrays


def _unpacked(data: memoryview, most: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, max(most, 1))
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if unpacker.unconsumed_tail:
        raise ValueError("it unpacks to far more than a recording does")
    if not unpacker.eof:
        raise ValueError("a packed array is cut off")
    return unpacked


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    """The elements that follow each other in `data`; a packed one is not padded to eight bytes."""
    at, byteorder = 0, "little" if order == "<" else "big"
    while at + 8 <= len(data):
        first = int.from_bytes(data[at : at + 4], byteorder)  # type: ignore[arg-type]
        if first >> 16:  # of up to four bytes, which stand in the tag itself
            kind, size, begin, step = first & 0xFFFF, first >> 16, at + 4, 8
        else:
            kind, size, begin = first, int.from_bytes(data[at + 4 : at + 8], byteorder), at + 8  # type: ignore[arg-type]
            step = 8 + size if kind == _COMPRESSED else 8 + (size + 7) // 8 * 8
        if begin + size > len(data) or (step == 8 and first >> 16 and size > 4):
            raise ValueError("an array is cut off")
        yield _Element(kind, data[begin : begin + size])
        at += step


def _walk(at: str, data: memoryview, order: str, arrays: dict[str, np.ndarray], depth: int, name: str = "") -> None:
    """Collect the arrays of a matrix at the path `at`; `name` is that of a struct's field."""
    parts = _elements(data, order)
    flags, shape, own = (_numbers(next(parts, None), order) for _ in range(3))
    whole = all(part.dtype.kind in "iu" for part in (flags, shape, own))
    if not whole or len(flags) < 1 or len(shape) < 2 or (shape < 0).any() or depth > DEEPEST:
        raise ValueError("the head of an array is damaged")
    kind, size = int(flags[0]) & 0xFF, int(np.prod(shape, dtype=object))
    where = f"{at}/{name or own.astype('u1').tobytes().decode('utf-8', errors='replace')}"
    if kind == _STRUCT and size == 1:
        for field in _fields(parts, order):
            element = next(parts, None)
            if element is None or element.kind != _MATRIX:
                raise ValueError("a struct is cut off")
            if len(element.data):  # none: an empty field
                _walk(where, element.data, order, arrays, depth + 1, field)
    elif _FIRST_NUMERIC <= kind <= _LAST_NUMERIC and not int(flags[0]) & _COMPLEX:
        values = _numbers(next(parts, None), order)
        if len(values) != size:
            raise ValueError(f"an array of {size} numbers holds {len(values)}")
        array = values.reshape(shape.tolist(), order="F").squeeze()
        if array.ndim <= 2:
            arrays[where] = array


def _fields(parts: Iterator[_Element], order: str) -> list[str]:
    """Read the names of a struct's fields."""
    longest, names = _numbers(next(parts, None), order), next(parts, None)
    if len(longest) != 1 or not 0 < longest[0] < 4096 or names is None:
        raise ValueError("the fields of a struct are damaged")
    text, width = bytes(names.data), int(longest[0])
    cells = [text[k : k + width].split(b"\0")[0] for k in range(0, len(text), width)]
    return [cell.decode("utf-8", errors="replace") for cell in cells]


def _numbers(element: _Element | None, order: str) -> np.ndarray:
    if element is None or element.kind not in _NUMBERS:
        raise ValueError("an array is cut off, or holds no numbers")
    kind = np.dtype(order + _NUMBERS[element.kind])
    return np.frombuffer(element.data[: len(element.data) // kind.itemsize * kind.itemsize], kind)
