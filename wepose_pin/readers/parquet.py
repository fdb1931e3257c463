"""Checks of Parquet files before polars reads them: some damaged ones make polars end the process.

Walks the footer and the header of every page; the values themselves, which may be packed, are polars'. What is read is
written in Thrift's compact protocol. Sources: github.com/apache/parquet-format, README.md, Encodings.md and
parquet.thrift (numbers of fields below are from there); github.com/apache/thrift, doc/specs/thrift-compact-protocol.md.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import BadData

MAGIC = b"PAR1"
DEEPEST = 16  # structs within structs
HEADER = 512  # [bytes] that are read for a page's header, and more where it is longer
# Bytes of a value at least, by the number of its type: booleans, int32, int64, int96, float, double, text.
_WIDTH = (0, 4, 8, 12, 4, 8, 4)
_FIXED = 7  # bytes of a length that the schema states
_DATA, _INDEX, _DICTIONARY, _DATA_V2 = range(4)
_REPEATED = 2
_NESTED = "lists or structs; each number needs a cell of its own"


class Contents(NamedTuple):
    """The contents of a file, as it states them.

    Parameters
    ----------
    rows : how many
    sizes : bytes of each column once unpacked, by its name: eight a cell, or what its pages say where that is more
    """

    rows: int
    sizes: dict[str, int]


def read_contents(path: Path) -> Contents:
    """Read the contents of a Parquet file of flat columns, and check that its footer and page headers agree.

    Raises
    ------
    BadData
        They do not, or a column holds lists or structs.
    """
    try:
        with path.open("rb", buffering=0) as file:
            return _walk(file.fileno(), os.fstat(file.fileno()).st_size)
    except (ValueError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BadData(f"{path}: cannot be read as a Parquet file: {reason}") from error


def _walk(file: int, size: int) -> Contents:
    if size < 12 or os.pread(file, 4, 0) != MAGIC or os.pread(file, 4, size - 4) != MAGIC:
        raise ValueError("it does not begin and end with PAR1; it is cut off, or of another format")
    length = int.from_bytes(os.pread(file, 4, size - 8), "little")
    end = size - 8 - length
    if end < 4:
        raise ValueError(f"its footer is said to be {length} bytes long, the file is {size}")
    try:
        about, _ = _struct(os.pread(file, length, end), 0, 0)
    except IndexError:
        raise ValueError("its footer is damaged") from None
    leaves = _leaves(_field(about, 2, list, "its footer"))
    rows, groups = _field(about, 3, int, "its footer"), _field(about, 4, list, "its footer")
    seen = packed = 0
    unpacked = [0] * len(leaves)
    for k, group in enumerate(groups):
        where = f"row group {k + 1}"
        chunks, height = _field(group, 1, list, where), _field(group, 3, int, where)
        if len(chunks) != len(leaves) or height < 0:
            raise ValueError(f"{where} has {len(chunks)} columns and {height} rows, the schema {len(leaves)} columns")
        for i, (leaf, chunk) in enumerate(zip(leaves, chunks, strict=True)):
            column = f"column '{leaf.name}' of {where}"
            there, grown = _chunk(file, end, leaf, height, chunk, column)
            packed += there
            unpacked[i] += grown
            if packed > end:
                raise ValueError(f"{column} lies where another column does")
        seen += height
    if seen != rows:
        raise ValueError(f"it is said to hold {rows} rows, its row groups hold {seen}")
    sizes = (max(rows * max(8, leaf.width), size) for leaf, size in zip(leaves, unpacked, strict=True))
    return Contents(rows, dict(zip((leaf.name for leaf in leaves), sizes, strict=True)))


class _Leaf(NamedTuple):
    name: str
    type: int
    width: int  # [bytes] of a value at least


def _leaves(schema: list[Any]) -> list[_Leaf]:
    """The columns: all elements of the schema but the first, which is the table itself."""
    if not schema or _field(schema[0], 5, int, "the schema", 0) != len(schema) - 1:
        raise ValueError(f"a column holds {_NESTED}")
    leaves = []
    for element in schema[1:]:
        name = _field(element, 4, bytes, "the schema").decode("utf-8", errors="replace")
        kind, repetition = (_field(element, number, int, f"column '{name}'") for number in (1, 3))
        if repetition == _REPEATED or _field(element, 5, int, f"column '{name}'", 0):
            raise ValueError(f"column '{name}' holds {_NESTED}")
        if not 0 <= kind <= _FIXED:
            raise ValueError(f"column '{name}' is of type {kind}, which is none")
        width = _field(element, 2, int, f"column '{name}'") if kind == _FIXED else _WIDTH[kind]
        if width < 0:
            raise ValueError(f"column '{name}' has values of {width} bytes")
        leaves.append(_Leaf(name, kind, width))
    names = [leaf.name for leaf in leaves]
    if len(set(names)) < len(names):
        name = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"column '{name}' stands there more than once; each column needs a name of its own")
    return leaves


def _chunk(file: int, end: int, leaf: _Leaf, rows: int, chunk: Any, where: str) -> tuple[int, int]:
    """Compute the bytes of a column of a row group, packed and unpacked; the footer begins at `end`."""
    about = _field(chunk, 3, dict, where)
    if chunk.get(1):
        raise ValueError(f"{where} lies in another file")
    kind, codec, values, size, first = (_field(about, number, int, where) for number in (1, 4, 5, 7, 9))
    at = _field(about, 11, int, where, first)  # with a dictionary polars begins there
    if kind != leaf.type:
        raise ValueError(f"{where} is of type {kind}, the schema says {leaf.type}")
    if values != rows:
        raise ValueError(f"{where} is said to hold {values} values, the row group {rows} rows")
    if at < (4 if values else 0) or size < 0 or at + size > end:
        raise ValueError(f"{where} is said to lie at {at} to {at + size}, the columns end at {end}")
    until, value_count, unpacked = at + size, 0, 0
    while value_count < values:
        if at >= until:
            raise ValueError(f"{where} is said to hold {values} values, its pages hold {value_count}")
        header, at = _page_header(file, at, until, where)
        kind, grown, packed = (_field(header, number, int, where) for number in (1, 2, 3))
        if not 0 <= packed <= until - at or grown < 0 or (not codec and grown != packed):
            raise ValueError(
                f"a page of {where} is said to take {packed} bytes, {grown} unpacked; there are {until - at}"
            )
        if kind == _DATA:
            value_count += _count(_field(header, 5, dict, where), 1, values - value_count, where)
        elif kind == _DATA_V2:
            page = _field(header, 8, dict, where)
            count = _count(page, 1, values - value_count, where)
            _count(page, 2, count, where)
            if _field(page, 3, int, where) != count:
                raise ValueError(f"a page of {where} is said to hold {count} values, in other than {count} rows")
            if _count(page, 5, packed, where) + _count(page, 6, packed, where) > min(packed, grown):
                raise ValueError(f"a page of {where} is said to be shorter than its parts")
            value_count += count
        elif kind == _DICTIONARY:
            _count(_field(header, 7, dict, where), 1, grown // max(leaf.width, 1), where)
        elif kind != _INDEX:
            raise ValueError(f"a page of {where} is of kind {kind}, which is none")
        at, unpacked = at + packed, unpacked + grown
    return size, unpacked


def _count(page: Any, number: int, most: int, where: str) -> int:
    count = _field(page, number, int, where)
    if not 0 <= count <= most:
        raise ValueError(f"a page of {where} is said to hold {count} values, there is room for {most}")
    return count


def _page_header(file: int, at: int, until: int, where: str) -> tuple[dict[int, Any], int]:
    """Read a page's header, and the position of its data."""
    length = HEADER
    while True:
        data = os.pread(file, min(length, until - at), at)
        try:
            header, used = _struct(data, 0, 0)
        except IndexError:
            if len(data) < length:
                raise ValueError(f"the header of a page of {where} is damaged") from None
            length *= 16
        else:
            return header, at + used


# Thrift ------------------------------------------------------------------------------------------------------------


def _field(struct: Any, number: int, kind: type, where: str, default: Any = None) -> Any:
    """Return a field of a struct, of this kind; without a default it is required."""
    value = struct.get(number, default) if type(struct) is dict else None
    if type(value) is not kind:
        raise ValueError(f"{where} is damaged")
    return value


def _struct(data: bytes, at: int, depth: int) -> tuple[dict[int, Any], int]:
    """Read the struct at `at`, by the numbers of its fields, and its end; IndexError: it is cut off."""
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        if head >> 4:
            number += head >> 4
        else:
            number, at = _integer(data, at)
        if number in fields:
            raise ValueError("a value in its footer or a page's header stands there twice")
        kind = head & 15
        if kind in (1, 2):  # true and false are in the head itself
            fields[number] = kind == 1
        else:
            fields[number], at = _value(kind, data, at, depth)
    return fields, at + 1


def _value(kind: int, data: bytes, at: int, depth: int) -> tuple[Any, int]:
    if kind in (4, 5, 6):
        return _integer(data, at)
    if kind == 8:
        length, at = _varint(data, at)
        if at + length > len(data):
            raise IndexError
        return data[at : at + length], at + length
    if depth > DEEPEST:
        raise ValueError("its footer or a page's header is nested without end")
    if kind in (9, 10):
        return _list(data, at, depth + 1)
    if kind == 12:
        return _struct(data, at, depth + 1)
    if kind in (1, 2, 3):  # in a list true and false are bytes
        return data[at], at + 1
    if kind == 7:
        return data[at : at + 8], at + 8
    raise ValueError(f"a value in its footer or a page's header is of kind {kind}, which is none")


def _list(data: bytes, at: int, depth: int) -> tuple[list[Any], int]:
    head = data[at]
    length, at = (head >> 4, at + 1) if head >> 4 < 15 else _varint(data, at + 1)
    if length > len(data) - at:  # none is shorter than a byte
        raise IndexError
    values = []
    for _ in range(length):
        value, at = _value(head & 15, data, at, depth)
        values.append(value)
    return values, at


def _integer(data: bytes, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    byte = data[at]
    at += 1
    if byte < 128:
        return byte, at
    value, shift = byte & 127, 7
    while shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
    raise ValueError("a number in its footer or a page's header has no end")
