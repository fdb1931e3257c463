"""Fixtures: where the real recordings lie, and one simulated person that several tests look at."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

import pytest

# numba's cache does not see a change in a function of another file that was compiled into a caller: the tests keep one
# cache for each state of the sources. Set before anything imports numba.
_SOURCES = sorted((Path(__file__).resolve().parent.parent / "wepose_pin").rglob("*.py"))
_STATE = hashlib.sha256(
    b"".join(path.read_bytes() for path in _SOURCES if b"compiled" in path.read_bytes())
).hexdigest()
os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / f"wepose-pin-numba-{_STATE[:16]}")

from wepose_pin.simulation import Person, Simulation, simulate, simulated_person  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("WEPOSE_DATA") or ROOT.parent / "shared" / "data")
_WITHOUT_DATA = "no real recordings at"


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the real recordings (`WEPOSE_DATA`, ``../shared/data`` by default); the test is skipped without it."""
    if not DATA.is_dir():
        pytest.skip(f"{_WITHOUT_DATA} {DATA}; WEPOSE_DATA names their folder")
    return DATA


@pytest.fixture(scope="session")
def person() -> Person:
    return simulated_person(3)


@pytest.fixture(scope="session")
def simulation(person: Person) -> Simulation:
    """Two minutes of clasp and circles with the noise of an MTi-3."""
    return simulate(person.lengths, seed=3)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    skipped = [report for report in terminalreporter.stats.get("skipped", []) if _WITHOUT_DATA in str(report.longrepr)]
    terminalreporter.write_line(f"tests skipped for want of the real recordings: {len(skipped)}")
