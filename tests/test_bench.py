"""`wepose bench`: what it measures has the shape it should, files round trip; no test looks at a time."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wepose_pin import bench
from wepose_pin.cli import main
from wepose_pin.errors import BadData, MissingFile
from wepose_pin.filters import METHODS

TINY = bench.Effort(2, 8.0, 1.0, (200, 400), (1, 3), 1, 1, False, clasp_s=10.0, solves=1)


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)


@pytest.fixture
def without_peers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "have", lambda peer: importlib.util.find_spec(peer) is not None and peer == "numba")


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command with little to measure."""
    monkeypatch.setattr(bench, "QUICK", TINY)
    monkeypatch.delenv("WEPOSE_DATA", raising=False)


@pytest.mark.usefixtures("without_peers")
def test_every_method_is_measured() -> None:
    found = {name: measure() for name, measure in bench.sections(TINY).items()}
    assert "first_use" in bench.sections(bench.FULL)
    assert set(found["filters"].rows) == {*METHODS, "static detector"}
    assert set(found["accuracy"].rows) == set(METHODS)
    assert set(found["samples"].rows) == {"2e2 samples", "4e2 samples"}
    assert set(found["sensors"].rows) == set(found["live"].rows) == {"1 sensor", "3 sensors"}
    for name, table in found.items():
        for row in table.rows.values():
            assert set(row) <= {column.key for column in table.columns}
            assert all(value >= 0.0 for value in row.values())
            assert name == "calibration" or not any("ratio" in key for key in row)
    assert any("pip install 'wepose-pin[peers]'" in note for note in found["filters"].notes)
    for causal in ("smekf", "ncf", "gdc"):
        assert found["filters"].rows[causal]["live_ns"] > 0.0
    assert 0.0 < found["accuracy"].rows["smekf"]["total_rmse"] < 1.0


def test_scipy_solves_the_same_calibration() -> None:
    rows = bench.calibration(TINY).rows
    names = [name.partition(": ")[2] for name in rows]
    solvers = ["Gauss-Newton, ours", "least_squares, our Jacobian", "least_squares, 2-point"]
    assert names == ["building", *solvers, "whole"]
    for name, row in rows.items():
        assert "cost" not in row or row["cost"] == pytest.approx(1.0, abs=1e-3), name
    assert len({name.partition(":")[0] for name in rows}) == 1
    assert bench.FULL.look_rates_hz[-1] == 100.0


@pytest.mark.skipif(not (bench.have("vqf") and bench.have("imufusion")), reason="no peers installed")
def test_the_peers_get_the_units_and_orders_they_want() -> None:
    """Wrong ones would not leave them near the truth."""
    found = bench.simulated_accuracy(TINY)
    for peer, limit in (("VQF", 1.0), ("offline VQF", 1.0), ("imufusion", 8.0)):
        assert found.rows[peer]["total_rmse"] < limit
    table = bench.filters(TINY)
    assert table.rows["VQF"]["batch_ratio"] == table.rows["VQF"]["live_ratio"] == 1.0
    assert not table.notes[-1].startswith("No ratios")


def test_cases_take_turns_and_the_first_round_is_left_out() -> None:
    order: list[str] = []
    now = 0.0

    def case(name: str, cost: Callable[[], float]) -> Callable[[], None]:
        def spend() -> None:
            nonlocal now
            order.append(name)
            now += cost()

        return spend

    slow = iter([100.0, 4.0, 8.0, 6.0])  # the first is the warm-up
    found = bench.in_turn({"a": case("a", lambda: next(slow)), "b": case("b", lambda: 2.0)}, 3, "b", lambda: now)
    assert order == ["a", "b"] * 4
    assert found["a"] == (6.0, 2.0, 3.0)
    assert found["b"].ratio == 1.0
    assert np.isnan(bench.in_turn({"a": lambda: None}, 2, "b")["a"].ratio)


@pytest.mark.usefixtures("fast")
def test_save_and_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    of_all = bench.sections
    monkeypatch.setattr(bench, "sections", lambda *effort: {"filters": of_all(*effort)["filters"]})
    before = tmp_path / "before.json"
    assert run("bench", "--quick", "--save", before) == 0
    assert str(before) in capsys.readouterr().out
    saved = json.loads(before.read_text())
    assert saved["format"] == bench.FORMAT
    assert {"date", "machine", "versions", "sections", "quick"} <= set(saved)
    assert set(saved["sections"]["filters"]["rows"]) >= set(METHODS)
    assert run("bench", "--quick", "--save", before) == 2
    assert "--force" in capsys.readouterr().err
    assert run("bench", "--quick", "--compare", before, "--save", before, "--force") == 0
    text = capsys.readouterr().out
    assert "then/now" in text
    assert saved["date"] in text


def test_then_by_now() -> None:
    before: dict[str, Any] = {"sections": {"filters": {"rows": {"smekf": {"batch_ratio": 2.0, "live_ratio": None}}}}}
    assert bench.then_by_now(before, "filters", "smekf", "batch_ratio", 0.25) == 8.0
    for section, name, key in (
        ("live", "smekf", "ratio"),
        ("filters", "amekf", "x"),
        ("filters", "smekf", "live_ratio"),
    ):
        assert np.isnan(bench.then_by_now(before, section, name, key, 1.0))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 99, "sections": {}}', '{"format": 1, "sections": 3}', "\xff"]
)
def test_a_file_that_is_none_of_ours(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "wrong.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(BadData, match=r"wrong\.json"):
        bench.read_document(path)
    assert run("bench", "--compare", path) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "wrong.json" in error


def test_files_that_are_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MissingFile, match="bench --save"):
        bench.read_document(tmp_path / "none.json")
    for words in (
        ("--compare", tmp_path / "none.json"),
        ("--data", tmp_path / "nowhere"),
        ("--save", tmp_path / "no" / "such.json"),
        ("--save", tmp_path, "--force"),
    ):
        assert run("bench", *words) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert str(words[1]) in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("without_peers")
def test_real_recordings_when_at_hand(data: Path) -> None:
    table = bench.sections(TINY, data)["recordings"]()
    assert "1 of BROAD and the authors' trial" in table.title
    assert 0.5 < table.rows["smekf"]["total_rmse"] < 10.0


def test_a_figure_that_there_is_none_of_is_left_out_of_the_file() -> None:
    table = bench.Table("of", (bench.Column("a", "a"), bench.Column("b", "b")), {"row": {"a": 1.5, "b": float("nan")}})
    text = json.dumps(bench.document({"of": table}, False, {}), allow_nan=False)
    assert json.loads(text)["sections"]["of"]["rows"] == {"row": {"a": 1.5}}
