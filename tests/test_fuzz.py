"""Whatever a file or datagram holds, it is taken, or refused in one line; recordings as users break them.

What was found by it, each with what should happen: test_fuzz_found.py.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest

pytest.importorskip("hypothesis")
from fuzz.targets import NUMBERS, TARGETS, Target, try_one
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_bad_input import RATE, SESSION, good_table

import wepose_pin as wp
from wepose_pin.errors import WeposeError

SLOW = {"retarget": 8}  # examples of targets that take their time
WORD = re.compile(rb'[\w.+-]+|"[^"]*"')


def quick(examples: int) -> settings:
    """The same inputs every time, and as many."""
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    return settings(max_examples=examples, deadline=None, derandomize=True, database=None, suppress_health_check=checks)


# Bytes -------------------------------------------------------------------------------------------------------------


@st.composite
def spoiled(draw: st.DrawFn, target: Target) -> bytes:
    """A well-formed input with some edits: bits turned over, words put in or exchanged, lines doubled, ends cut off."""
    data = bytearray(draw(st.sampled_from(target.seeds())))
    words = target.words or NUMBERS
    for _ in range(draw(st.integers(1, 5))):
        at = draw(st.integers(0, len(data)))
        edit = draw(st.sampled_from(("flip", "delete", "insert", "exchange", "double", "cut", "bytes")))
        if edit == "flip" and at < len(data):
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif edit == "delete":
            del data[at : at + draw(st.sampled_from((1, 2, 8, 64, 512)))]
        elif edit == "insert":
            data[at:at] = draw(st.sampled_from(words))
        elif edit == "exchange" and (spans := [match.span() for match in WORD.finditer(data)]):
            first, last = draw(st.sampled_from(spans))
            data[first:last] = draw(st.sampled_from(words))
        elif edit == "double":
            lines = bytes(data).splitlines(keepends=True)
            line = draw(st.sampled_from(lines)) if lines else b""
            data[at:at] = line
        elif edit == "cut":
            del data[at:]
        elif edit == "bytes":
            data[at : at + 4] = draw(st.binary(max_size=8))
    return bytes(data)


@pytest.mark.fuzz
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_what_is_spoiled_is_taken_or_refused_in_one_line(target: Target) -> None:
    outcomes = set()

    @quick(SLOW.get(target.name, 60))
    @given(data=spoiled(target))
    def tried(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            outcomes.add(try_one(target, Path(folder), data) is None)

    tried()
    assert outcomes, "nothing was tried"


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_what_the_spoiling_begins_with_is_well(target: Target, tmp_path: Path) -> None:
    for seed in target.seeds():
        assert try_one(target, tmp_path, seed) is None


# Recordings as users break them --------------------------------------------------------------------------------------

COLUMNS = ("time", "gx", "gy", "gz", "ax", "ay", "az")
VALUES = (None, float("nan"), float("inf"), 1e308, -1e308, 1e-308, 0.0, -9999.0, 2.0**63, 65535.0, 1e-3)


@st.composite
def broken_table(draw: st.DrawFn) -> pl.DataFrame:
    """The recording with rows lost, doubled, cut off or mixed up, cells exchanged, columns scaled or swapped."""
    table = good_table()
    for _ in range(draw(st.integers(1, 3))):
        n = table.height
        how = draw(st.sampled_from(("head", "lose", "double", "reverse", "cells", "scale", "swap", "still", "offset")))
        first = draw(st.integers(0, max(n - 1, 0)))
        last = min(n, first + draw(st.sampled_from((1, 2, 7, 100, 1000))))
        column = draw(st.sampled_from(COLUMNS))
        if how == "head":
            table = table.head(draw(st.sampled_from((0, 1, 2, 3, 10, 250, 300))))
        elif how == "lose":
            table = pl.concat([table.head(first), table.slice(last)])
        elif how == "double":
            table = pl.concat([table.head(last), table.slice(first)])
        elif how == "reverse":
            table = pl.concat([table.head(first), table.slice(first, last - first).reverse(), table.slice(last)])
        elif how == "cells":
            cells = table[column].to_list()
            cells[first:last] = [draw(st.sampled_from(VALUES))] * (min(last, n) - first)
            table = table.with_columns(pl.Series(column, cells, dtype=pl.Float64))
        elif how == "scale":
            table = table.with_columns(pl.col(column) * draw(st.sampled_from((-1.0, 0.0, 1e-3, 57.3, 1e3, 1e9, 1e300))))
        elif how == "swap":
            other = draw(st.sampled_from([name for name in COLUMNS if name != column]))
            table = table.with_columns(table[column].alias(other), table[other].alias(column))
        elif how == "still":
            table = table.with_columns(pl.lit(table[column][0] if n else None, dtype=pl.Float64).alias(column))
        elif how == "offset":
            table = table.with_columns(pl.col(column) + draw(st.sampled_from((-1e3, 1e6, 1.7e9, 1e15))))
    return table


@pytest.mark.fuzz
@quick(150)
@given(
    table=broken_table(),
    suffix=st.sampled_from((".csv", ".parquet")),
    phases=st.sampled_from(
        ("start = [[0.5, 2.5]]", "", "start = [[0.0, 8.99]]", "static = [[0, 1]]\nstart = [[1, 2]]")
    ),
    gaps=st.booleans(),
)
def test_a_broken_recording_is_tracked_to_numbers_or_refused(
    table: pl.DataFrame, suffix: str, phases: str, gaps: bool
) -> None:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        session = SESSION.replace("arm.csv", f"arm{suffix}").replace("start = [[0.5, 2.5]]", phases)
        (folder / "session.toml").write_text(session, encoding="utf-8")
        if suffix == ".csv":
            table.write_csv(folder / "arm.csv")
        else:
            table.write_parquet(folder / "arm.parquet")
        try:
            recording = wp.load_session(folder / "session.toml", gaps=gaps)
            pose = wp.track(recording)
        except WeposeError:  # of one line, whatever it holds: errors.py
            return
    assert len(pose.time) == len(recording)
    assert recording.rate_hz <= 1.01 * RATE
    for quat in pose.quat_WL.values():
        np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-6)
    for point in pose.points.values():
        assert np.isfinite(point).all()
