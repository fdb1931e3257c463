"""Parquet files: what polars writes is taken; what lies about itself is refused before polars, which may die of it."""

from __future__ import annotations

import copy
import struct
import subprocess
import sys
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from wepose_pin.errors import BadData, UnknownColumn
from wepose_pin.readers import tables
from wepose_pin.readers.parquet import read_contents

VALUES = np.arange(12.0)
N = len(VALUES)


class Long(int):
    """An integer that the format keeps in 64 bits."""


def thrift(value: Any) -> bytes:
    """A struct as {number: field} in Thrift's compact protocol, or what it consists of."""
    if isinstance(value, int):
        return varint(2 * value if value >= 0 else -2 * value - 1)
    if isinstance(value, bytes):
        return varint(len(value)) + value
    if isinstance(value, list):
        inner = kind(value[0]) if value else kind({})
        return bytes([0xF0 | inner]) + varint(len(value)) + b"".join(map(thrift, value))
    fields = (bytes([kind(field)]) + thrift(number) + thrift(field) for number, field in sorted(value.items()))
    return b"".join(fields) + b"\0"


def kind(value: Any) -> int:
    return 6 if isinstance(value, Long) else {int: 5, bytes: 8, list: 9, dict: 12}[type(value)]


def varint(value: int) -> bytes:
    groups = [value >> shift & 127 for shift in range(0, max(value.bit_length(), 1), 7)]
    return bytes([*(group | 128 for group in groups[:-1]), groups[-1]])


LEVELS = struct.pack("<IBB", 2, 2 * N, 1)  # no cell is empty: one run of ones
PLAIN = {1: 0, 2: len(LEVELS) + 8 * N, 3: len(LEVELS) + 8 * N, 5: {1: N, 2: 0, 3: 3, 4: 3}}
V2 = {1: 3, 2: 2 + 8 * N, 3: 2 + 8 * N, 8: {1: N, 2: 0, 3: N, 4: 0, 5: 2, 6: 0}}
DICTIONARY = {1: 2, 2: 8 * N, 3: 8 * N, 7: {1: N, 2: 0}}
INDICES = LEVELS + bytes([4, 5]) + bytes.fromhex("1032547698ba") + bytes(2)  # of 4 bits, two runs of eight
BY_INDEX = {1: 0, 2: len(INDICES), 3: len(INDICES), 5: {1: N, 2: 8, 3: 3, 4: 3}}
PAGES = {
    "plain": [(PLAIN, LEVELS + VALUES.tobytes())],
    "v2": [(V2, LEVELS[4:] + VALUES.tobytes())],
    "dictionary": [(DICTIONARY, VALUES.tobytes()), (BY_INDEX, INDICES)],
}


def made(pages: str = "plain", changed: tuple[Any, ...] = (), to: Any = None, names: bytes = b"a") -> bytes:
    """A file of one column 'a' with `VALUES`; what stands at the path `changed` is something else, None: not there.

    More `names` are more columns, which all lie in the place of the first.
    """
    parts = {"page": copy.deepcopy([header for header, _ in PAGES[pages]])}
    spoil(parts, changed, to)
    body = b"".join(thrift(header) + data for header, (_, data) in zip(parts["page"], PAGES[pages], strict=True))
    column = {1: 5, 2: [0], 3: [b"a"], 4: 0, 5: Long(N), 6: Long(len(body)), 7: Long(len(body)), 9: Long(4)}
    group = {1: [{2: Long(4), 3: column}] * len(names), 2: Long(len(body)), 3: Long(N)}
    schema = [{4: b"table", 5: len(names)}, *({1: 5, 3: 1, 4: bytes([name])} for name in names)]
    parts = {"file": {1: 1, 2: schema, 3: Long(N), 4: [group]}}
    spoil(parts, changed, to)
    footer = thrift(parts["file"])
    return b"PAR1" + body + footer + struct.pack("<I", len(footer)) + b"PAR1"


def spoil(parts: dict[str, Any], changed: tuple[Any, ...], to: Any) -> None:
    if changed and changed[0] in parts:
        place = reduce(lambda struct, key: struct[key], changed[:-1], parts)
        if to is None:
            del place[changed[-1]]
        else:
            place[changed[-1]] = to


def refusal(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    with pytest.raises(BadData) as refused:
        read_contents(path)
    return str(refused.value).removeprefix(f"{path}: cannot be read as a Parquet file: ")


# What is well ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pages", PAGES)
def test_a_file_made_by_hand_is_what_polars_takes(pages: str, tmp_path: Path) -> None:
    """So that what is refused below is refused for what was changed."""
    (tmp_path / "a.parquet").write_bytes(made(pages))
    assert pl.read_parquet(tmp_path / "a.parquet")["a"].to_list() == VALUES.tolist()
    assert read_contents(tmp_path / "a.parquet") == (N, {"a": max(8 * N, sum(header[2] for header, _ in PAGES[pages]))})


@pytest.mark.parametrize("compression", ["uncompressed", "snappy", "zstd", "gzip", "lz4", "brotli"])
@pytest.mark.parametrize(
    "options", [{}, {"data_page_size": 100, "row_group_size": 70}, {"statistics": False}, {"statistics": "full"}]
)
def test_what_polars_writes_is_taken(options: dict[str, Any], compression: Any, tmp_path: Path) -> None:
    k = pl.int_range(200, eager=True)
    table = pl.DataFrame({
        **{"float": k / 7, "single": (k / 7).cast(pl.Float32), "whole": k, "short": (k % 9).cast(pl.Int8)},
        **{"some": pl.Series([None if i % 3 else i / 7 for i in k]), "none": [None] * 200, "flag": k % 2 == 0},
        **{"text": (k % 9).cast(pl.String), "bytes": k.cast(pl.String).cast(pl.Binary), "day": k.cast(pl.Date)},
        **{"when": k.cast(pl.Datetime("us")), "exact": k.cast(pl.Decimal(30, 2))},
        "class": (k % 9).cast(pl.String).cast(pl.Categorical),
    })  # fmt: skip
    for part in (table, table.head(0), table.head(1)):
        part.write_parquet(tmp_path / "a.parquet", compression=compression, **options)
        contents = read_contents(tmp_path / "a.parquet")
        assert contents.rows == part.height
        assert list(contents.sizes) == part.columns
        assert all(size >= 8 * part.height for size in contents.sizes.values())
        assert tables.read_table(tmp_path / "a.parquet").equals(part)


def test_a_table_without_columns(tmp_path: Path) -> None:
    pl.DataFrame().write_parquet(tmp_path / "a.parquet")
    assert read_contents(tmp_path / "a.parquet") == (0, {})


def test_a_column_is_sought_in_what_the_file_holds(tmp_path: Path) -> None:
    pl.DataFrame({"time": VALUES}).write_parquet(tmp_path / "a.parquet")
    values, height = tables.read_column(tmp_path / "a.parquet", "time", "a.parquet", "data.time")
    assert (values.tolist(), height) == (VALUES.tolist(), N)
    with pytest.raises(UnknownColumn, match=r"data.time: no column 'tine' in a.parquet; did you mean 'time'\?"):
        tables.read_column(tmp_path / "a.parquet", "tine", "a.parquet", "data.time")


def test_how_often_a_file_is_walked_does_not_grow_with_the_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pl.DataFrame({"time": VALUES}).write_parquet(tmp_path / "a.parquet")
    walked = []
    monkeypatch.setattr(tables, "read_contents", lambda path: (walked.append(path), read_contents(path))[1])
    rows = tables.Rows(tmp_path / "a.parquet")
    assert [rows[k : k + 2]["time"].to_list() for k in range(0, N, 2)] == VALUES.reshape(-1, 2).tolist()
    assert len(walked) == 1


# What is not -------------------------------------------------------------------------------------------------------

COLUMN = ("file", 4, 0, 1, 0, 3)


@pytest.mark.parametrize(
    ("pages", "changed", "to", "says"),
    [
        ("plain", ("page", 0, 5, 1), -64, "a page of column 'a' of row group 1 is said to hold -64 values, there is"),
        ("plain", ("page", 0, 5, 1), 2**31 - 1, "is said to hold 2147483647 values, there is room for 12"),
        ("plain", ("page", 0, 5, 1), 11, "is said to hold 12 values, its pages hold 11"),
        ("plain", ("page", 0, 5, 1), 10**17, "is said to hold 100000000000000000 values"),
        ("plain", ("page", 0, 5), None, "column 'a' of row group 1 is damaged"),
        ("plain", ("page", 0, 3), 103, "is said to take 103 bytes, 102 unpacked; there are 102"),
        ("plain", ("page", 0, 3), -1, "is said to take -1 bytes"),
        ("plain", ("page", 0, 2), 2**31 - 1, "is said to take 102 bytes, 2147483647 unpacked"),
        ("plain", ("page", 0, 1), 4, "a page of column 'a' of row group 1 is of kind 4"),
        ("v2", ("page", 0, 8, 1), -1, "is said to hold -1 values"),
        ("v2", ("page", 0, 8, 2), 13, "is said to hold 13 values, there is room for 12"),
        ("v2", ("page", 0, 8, 3), 10**9, "is said to hold 12 values, in other than 12 rows"),
        ("v2", ("page", 0, 8, 5), 2**31 - 1, "is said to hold 2147483647"),
        ("v2", ("page", 0, 8, 6), 97, "is said to be shorter than its parts"),
        ("dictionary", ("page", 0, 7, 1), 2**31 - 1, "is said to hold 2147483647 values, there is room for 12"),
        ("dictionary", ("page", 1, 5, 1), 13, "is said to hold 13 values, there is room for 12"),
        ("plain", (*COLUMN, 5), Long(10**17), "said to hold 100000000000000000 values, the row group 12 rows"),
        ("plain", (*COLUMN, 1), 6, "is of type 6, the schema says 5"),
        ("plain", (*COLUMN, 7), Long(2**62), "is said to lie at 4 to"),
        ("plain", (*COLUMN, 7), Long(40), "a page of column 'a' of row group 1 is said to take 102 bytes"),
        ("plain", (*COLUMN, 9), Long(-4), "is said to lie at -4 to"),
        ("plain", (*COLUMN, 11), Long(0), "is said to lie at 0 to"),
        ("plain", (*COLUMN[:-1], 1), b"b.parquet", "lies in another file"),
        ("plain", (*COLUMN[:-1],), 7, "is damaged"),
        ("plain", COLUMN, None, "is damaged"),
        ("plain", ("file", 4, 0, 3), Long(10**17), "the row group 100000000000000000 rows"),
        ("plain", ("file", 4, 0, 3), Long(-1), "has 1 columns and -1 rows"),
        ("plain", ("file", 3), Long(10**17), "said to hold 100000000000000000 rows, its row groups hold 12"),
        ("plain", ("file", 2, 0, 5), 2, "a column holds lists or structs"),
        ("plain", ("file", 2, 1, 3), 2, "column 'a' holds lists or structs"),
        ("plain", ("file", 2, 1, 1), 8, "column 'a' is of type 8"),
        ("plain", ("file", 2, 1), {1: 7, 2: -1, 3: 1, 4: b"a"}, "column 'a' has values of -1 bytes"),
    ],
)
def test_what_a_file_says_of_itself_and_cannot_be(
    pages: str, changed: tuple[Any, ...], to: Any, says: str, tmp_path: Path
) -> None:
    assert says in refusal(tmp_path / "a.parquet", made(pages, changed, to))


def test_columns_of_one_name_or_in_one_place(tmp_path: Path) -> None:
    assert "column 'a' stands there more than once" in refusal(tmp_path / "a.parquet", made(names=b"aa"))
    assert "column 'b' of row group 1 lies where another" in refusal(tmp_path / "a.parquet", made(names=b"ab"))


def test_rows_of_no_columns(tmp_path: Path) -> None:
    """As many as one likes, of nothing: their times would be many all the same."""
    groups = [{1: [], 2: Long(0), 3: Long(10**17)}]
    footer = thrift({1: 1, 2: [{4: b"table", 5: 0}], 3: Long(10**17), 4: groups})
    (tmp_path / "a.parquet").write_bytes(b"PAR1" + footer + struct.pack("<I", len(footer)) + b"PAR1")
    with pytest.raises(BadData, match="holds 100000000000000000 rows of 0 columns"):
        tables.read_column(tmp_path / "a.parquet", None, "a.parquet", "data.time")


@pytest.mark.parametrize("at", ["beginning", "end"])
def test_what_is_no_parquet(at: str, tmp_path: Path) -> None:
    good = made()
    spoiled = b"PARX" + good[4:] if at == "beginning" else good[:-1]
    assert "does not begin and end with PAR1" in refusal(tmp_path / "a.parquet", spoiled)


@pytest.mark.parametrize(
    ("footer", "says"),
    [
        (b"\x19" * 50_000, "nested without end"),
        (b"\x1c" * 50_000, "nested without end"),
        (b"\x19\xfc" + varint(2**60), "its footer is damaged"),
        (b"\x18" + varint(2**60), "its footer is damaged"),
        (b"\x15" + b"\xff" * 50, "has no end"),
        (b"\x1e\0", "of kind 14"),
        (b"\x15\0\x05\x02\0", "twice"),
        (b"", "its footer is damaged"),
        (b"\0", "its footer is damaged"),
    ],
)
def test_a_footer_that_is_none(footer: bytes, says: str, tmp_path: Path) -> None:
    data = b"PAR1" + footer + struct.pack("<I", len(footer)) + b"PAR1"
    assert says in refusal(tmp_path / "a.parquet", data)


@pytest.mark.parametrize("pages", PAGES)
def test_a_footer_cut_off_anywhere(pages: str, tmp_path: Path) -> None:
    good = made(pages)
    length = struct.unpack_from("<I", good, len(good) - 8)[0]
    for cut in range(1, length):
        data = good[: -8 - cut] + struct.pack("<I", length - cut) + b"PAR1"
        assert refusal(tmp_path / "a.parquet", data)


def test_a_page_of_which_polars_dies_is_one_line(tmp_path: Path) -> None:
    """In a process of its own: polars asks for 2·10¹⁸ bytes, and no exception comes of it."""
    (tmp_path / "a.parquet").write_bytes(made("plain", ("page", 0, 5, 1), -64))
    command = [sys.executable, "-m", "wepose_pin.cli", "info", str(tmp_path / "a.parquet")]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 2, run.stderr
    (line,) = run.stderr.splitlines()
    assert "a.parquet: cannot be read as a Parquet file: a page of column 'a' of row group 1" in line
