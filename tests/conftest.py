"""Fixtures: where the real recordings lie, and one simulated person that several tests look at."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from wepose_pin.simulation import Person, Simulation, simulate, simulated_person

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
