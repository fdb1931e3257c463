"""`python -m benchmarks`: tables have the rows they should, saved figures are read again; no test looks at a time."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from benchmarks import accuracy, bodies, calibration, filters, tables
from benchmarks.__main__ import main
from wepose_pin.filters import METHODS

TINY = filters.Effort(2, 8.0, 1.0, 10.0, (1, 3), 1, 1, False)


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.fixture
def without_peers(monkeypatch: pytest.MonkeyPatch) -> None:
    def is_installed(name: str) -> bool:
        return name == "numba" and importlib.util.find_spec(name) is not None

    for module in (filters, accuracy, tables):
        monkeypatch.setattr(module, "is_installed", is_installed)


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command with little to measure."""
    monkeypatch.setattr(filters, "QUICK", TINY)
    monkeypatch.delenv("WEPOSE_DATA", raising=False)


@pytest.mark.slow
@pytest.mark.usefixtures("without_peers")
def test_every_method_is_measured() -> None:
    measured = {name: measure() for name, measure in filters.sections(TINY).items()}
    assert "first_use" in filters.sections(filters.FULL)
    assert set(measured["filters"].rows) == {*METHODS, *(f"{name}, inner run" for name in METHODS)}
    assert set(measured["recordings"].rows) == {"track", "calibrate"}
    assert set(measured["accuracy"].rows) == set(METHODS)
    assert set(measured["bank"].rows) == {"1 sensor", "3 sensors"}
    for table in measured.values():
        for row in table.rows.values():
            assert set(row) <= {column.key for column in table.columns}
            assert all(value >= 0.0 for value in row.values())
            assert not any("ratio" in key for key in row)
    assert any("pip install vqf imufusion" in note for note in measured["filters"].notes)
    for causal in ("smekf", "ncf", "gdc"):
        assert measured["live"].rows[causal]["ns"] > 0.0
    assert 0.0 < measured["accuracy"].rows["smekf"]["total_rmse"] < 1.0


@pytest.mark.slow
def test_nlpsol_and_the_loop_are_compared_on_every_kind_of_calibration() -> None:
    rows = calibration.solvers_by_case(15.0, 1).rows
    assert {"clasp", "clasp, unknown mounts", "clasp, 5 s", "t_pose+bow"} == set(rows)
    for name, row in rows.items():
        assert row["difference"] < 1.0, name
        assert row["nlpsol_s"] > 0.0 < row["loop_s"], name


@pytest.mark.skipif(not (tables.is_installed("vqf") and tables.is_installed("imufusion")), reason="no peers installed")
def test_the_peers_get_the_units_and_orders_they_want() -> None:
    """Wrong ones would not leave them near the truth."""
    errors = accuracy.simulated_accuracy(1)
    for peer, limit in (("VQF", 1.0), ("offline VQF", 1.0), ("imufusion", 8.0)):
        assert errors.rows[peer]["total_rmse"] < limit
    table = filters.filters(TINY)
    assert table.rows["VQF"]["ratio"] == filters.live(TINY).rows["VQF"]["ratio"] == 1.0
    assert not table.notes[-1].startswith("No ratios")


@pytest.mark.usefixtures("fast")
def test_save_and_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    every = filters.sections
    monkeypatch.setattr(filters, "sections", lambda *effort: {"filters": every(*effort)["filters"]})
    before = tmp_path / "before.json"
    assert run("filters", "--quick", "--save", before) == 0
    assert str(before) in capsys.readouterr().out
    saved = json.loads(before.read_text())
    assert {"date", "machine", "versions", "sections", "quick"} == set(saved)
    assert {"wepose-pin", "pin", "numba"} <= set(saved["versions"])
    assert set(saved["sections"]["filters"]["rows"]) >= set(METHODS)
    assert run("filters", "--quick", "--save", before) == 2
    assert "name a new file" in capsys.readouterr().err
    assert run("filters", "--quick", "--compare", before) == 0
    text = capsys.readouterr().out
    assert "before/now" in text
    assert saved["date"] in text


def test_what_cannot_be_measured_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wrong.json").write_text('{"sections": 3}')
    for words in (
        ("--compare", tmp_path / "wrong.json"),
        ("--compare", tmp_path / "none.json"),
        ("filters", "--data", tmp_path / "nowhere"),
        ("robots", "--data", tmp_path / "nowhere"),
        ("--save", tmp_path / "no" / "such.json"),
        ("live", "--sessions", 5),
    ):
        assert run(*words) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert str(words[-1]) in error
    with pytest.raises(SystemExit) as stop:
        run("thoughts")
    assert stop.value.code == 2


@pytest.mark.usefixtures("without_peers")
def test_real_recordings_when_at_hand(data: Path) -> None:
    table = filters.sections(TINY, data)["recorded_accuracy"]()
    assert "1 of BROAD and the authors' trial" in table.title
    assert 0.5 < table.rows["smekf"]["total_rmse"] < 10.0


def test_bodies_need_their_recordings_and_measure_a_simulated_arm(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WEPOSE_DATA", raising=False)
    assert run("bodies", "--data", tmp_path) == 2
    assert "bodies are measured on ring/, ur5/ and mvnx" in capsys.readouterr().err
    rows = bodies.measure_ur5_links((1,), tmp_path).rows
    assert list(rows) == ["seed 1 upper_arm", "seed 1 forearm"]
    for row in rows.values():
        assert abs(row["z"]) < 3.0
        assert row["std_mm"] < 0.1 * row["before_std_mm"]
        assert row["calibrated_mm"] - row["true_mm"] == pytest.approx(row["z"] * row["std_mm"])
    rows = bodies.measure_four_bar((1,), tmp_path).rows
    assert len(rows) == 15
    for row in rows.values():
        assert abs(row["z"]) < 3.0
        assert row["std_mm"] < 20.0
