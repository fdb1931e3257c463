"""`python -m benchmarks.results`: numbers are stored, compared bit for bit, and renamed by a table."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.results import adapter, inputs, saving, tasks
from benchmarks.results.__main__ import main
from benchmarks.results.arrays import Arrays
from benchmarks.results.comparison import difference_of


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr("sys.argv", ["results", *map(str, words)])
    return main()


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write(name: str, **arrays: list[float]) -> Path:
        folder = tmp_path / name
        (folder / "results").mkdir(parents=True)
        np.savez(folder / "results" / "a.npz", **{k: np.array(v) for k, v in arrays.items()})  # type: ignore[arg-type]
        return folder

    return write


def test_one_bit_is_a_difference() -> None:
    a = np.array([1.0, np.nan, 0.0])
    assert difference_of("key", a, a.copy()) is None
    for value, text in (
        ([np.nextafter(1.0, 2.0), np.nan, 0.0], "2.22e-16, 1 of 3"),
        ([1.0, 1.0, 0.0], "1 of 3 are NaN"),
    ):
        difference = difference_of("key", a, np.array(value))
        assert difference is not None
        assert text in difference.text
    sign = difference_of("key", a, np.array([1.0, np.nan, -0.0]))
    assert sign is not None
    assert "sign" in sign.text
    shape = difference_of("key", a, a[:2])
    assert shape is not None
    assert "(3,) → (2,)" in shape.text


def test_compare_with_renames_and_reasons(
    write: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = write("old", **{"track/left_hand_x": [1.0], "track/left_hand_qx": [2.0], "a/gone": [3.0], "a/b": [4.0, 5.0]})
    new = write("new", **{"track/left_palm_x": [1.0], "track/left_hand_qx": [2.0], "a/more": [3.0], "a/b": [4.0, 5.5]})
    assert run(monkeypatch, "compare", old, old) == 0
    assert "4 keys equal, 0 different" in capsys.readouterr().out
    assert run(monkeypatch, "compare", old, new) == 1
    assert "1 keys equal, 1 different, 2 missing, 2 new" in capsys.readouterr().out
    table = tmp_path / "renames.toml"
    table.write_text("[renames]\n'_hand_([xyz])$' = '_palm_\\1'\n")
    assert run(monkeypatch, "compare", old, new, "--renames", table) == 1
    out = capsys.readouterr().out
    assert "2 keys equal, 1 different, 1 missing, 1 new, 0 explained" in out
    assert "a/b: largest deviation 0.5, 1 of 2" in out
    assert run(monkeypatch, "compare", old, new, "--renames", table, "--only", "track/*") == 0
    table.write_text(table.read_text() + "[reasons]\n'^a/' = 'another a'\n")
    assert run(monkeypatch, "compare", old, new, "--renames", table) == 0
    assert "explained: 3 keys: another a" in capsys.readouterr().out


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two tasks on one recording, in this process."""

    def skipped(_: tasks.Places) -> Arrays:
        raise tasks.Missing("nothing here")

    chosen = [task for task in tasks.tasks() if task.name == "chain"] + [tasks.Task("other", skipped)]
    makers = inputs.makers()
    monkeypatch.setattr(saving, "tasks", lambda: chosen)
    monkeypatch.setattr(inputs, "makers", lambda: {"chain": makers["chain"]})
    monkeypatch.setattr(
        saving, "_run", lambda todo, out, data, *_: [saving.run_task(task.name, out, data) for task in todo]
    )


@pytest.mark.usefixtures("few")
def test_two_saves_are_bit_identical(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    assert run(monkeypatch, "save", a) == 0
    assert "skipped: other: nothing here" in capsys.readouterr().out
    monkeypatch.setattr(adapter, "SESSION_KEYS", {"^start = ": "start  = "})
    assert run(monkeypatch, "save", b, "--inputs", a / "inputs") == 0
    assert "start  = [[0.5, 3.5]]" in (b / "inputs" / "chain" / "session.toml").read_text()
    capsys.readouterr()
    assert run(monkeypatch, "compare", a, b) == 0
    assert "0 different, 0 missing, 0 new" in capsys.readouterr().out
    keys = set(np.load(a / "results" / "chain.npz").files)
    assert {"track/chain/amekf/whole/joints/elbow", "track/chain/amekf/whole/exit_code"} <= keys
