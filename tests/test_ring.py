"""The RING chain by the commands alone: lengths and orientations beside those of the validation's own script."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.bodies import measure_ring_links, measure_ring_orientations

MOUNTS = ["rigid", pytest.param("loose", marks=pytest.mark.slow)]


@pytest.mark.parametrize("mount", MOUNTS)
def test_lengths_of_links_are_the_optical_ones(data: Path, mount: str, tmp_path: Path) -> None:
    table = measure_ring_links(data, [mount], tmp_path)
    assert set(table.rows) == {f"{mount} seg2 and seg3", f"{mount} seg4"}
    for name, row in table.rows.items():
        off = abs(row["calibrated_mm"] - row["optical_mm"])
        assert off < 3.0 * row["std_mm"], name
        assert off < (0.5 if mount == "rigid" else 1.5), name
        assert off < abs(row["script_mm"] - row["optical_mm"]) + 0.5, name
        assert row["std_mm"] < 1.5, name


@pytest.mark.parametrize("mount", MOUNTS)
def test_orientations_are_those_of_the_script(data: Path, mount: str, tmp_path: Path) -> None:
    """Its sensors have their mounts and biases from the optical system, those of the command from its calibration."""
    rows = measure_ring_orientations(data, [mount], tmp_path).rows
    own, script = (np.array([row[key] for row in rows.values()]) for key in ("command_deg", "script_deg"))
    assert own.mean() < script.mean()
    assert (own < script + 1.0).all()
    assert own.max() < (1.5 if mount == "rigid" else 3.0)
