"""Plug-ins: the example's distribution is installed, and what it registers is used as what this package has."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from commands import run

import wepose_pin as wp
from wepose_pin.assets import find_plugins, load_plugin
from wepose_pin.errors import BadOption
from wepose_pin.live import open_source
from wepose_pin.writers import write_session
from wepose_pin.writers.export import list_formats

EXAMPLE = Path(__file__).parents[1] / "examples" / "plugin"
CACHES = (find_plugins, load_plugin, list_formats)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    shutil.copytree(EXAMPLE, tmp_path / "source")
    target = ["--target", tmp_path / "site", tmp_path / "source"]
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, *target], check=True)
    monkeypatch.syspath_prepend(tmp_path / "site")
    for cache in CACHES:
        cache.cache_clear()
    yield
    for cache in CACHES:
        cache.cache_clear()
    sys.modules.pop("wepose_acme", None)


@pytest.mark.usefixtures("installed")
def test_the_example_reads_writes_and_sends(
    half_minute: wp.Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "made").mkdir()
    write_session(tmp_path / "made", half_minute)
    assert run("track", "made", "-o", "result", "--no-view", "--no-report") == 0
    assert run("export", "result", "-o", "palm.acme", "--rate-hz", 50) == 0
    palm = np.loadtxt("palm.acme")
    assert palm.shape[1] == 4
    assert np.allclose(np.diff(palm[:, 0]), 0.02)

    torso = half_minute.imus["torso"]
    (tmp_path / "band").mkdir()
    np.savetxt("band/torso.acme", np.column_stack([half_minute.time, torso.gyro_S, torso.accel_S]))
    capsys.readouterr()
    assert run("info", "band/torso.acme", "--write") == 0
    assert "recording of an Acme Band" in capsys.readouterr().out
    assert 'format = "acme"' in Path("band/session.toml").read_text(encoding="utf-8")
    assert np.allclose(wp.load_session("band").imus["torso"].gyro_S, torso.gyro_S, atol=1e-3)

    assert open_source("acme:made").sensors == tuple(half_minute.sensors)
    assert run("live", "--source", "replay:made", "--speed", "max", "--no-page", "--output", "acme:height.txt") == 0
    height = np.loadtxt("height.txt")
    assert len(height) > 20
    assert np.all(np.diff(height[:, 0]) > 0)


def test_what_is_registered_is_listed_and_ours_is_registered_in_the_same_way() -> None:
    assert {"mvnx", "rosbag"} <= set(find_plugins("readers"))
    assert {"udp", "lsl"} == set(find_plugins("outputs"))
    with pytest.raises(BadOption, match="replay:PATH"):
        open_source("acme:made")
