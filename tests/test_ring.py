"""The RING chain by the commands alone: lengths and orientations beside those of the validation's own script."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
from ring_chain import write_ring_session
from scipy.spatial.transform import Rotation, Slerp

from wepose_pin.cli import main
from wepose_pin.evaluation import attitude_error
from wepose_pin.readers.trials import RING_SEGMENTS, find_ring
from wepose_pin.subject import load_subject
from wepose_pin.validation import real
from wepose_pin.validation.series import align_rotation


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


@pytest.mark.parametrize("mount", ["rigid", pytest.param("loose", marks=pytest.mark.slow)])
def test_ring_by_the_commands_alone(data: Path, mount: str, tmp_path: Path) -> None:
    [files] = find_ring(data)
    ring = write_ring_session(files, mount, tmp_path)
    body = ("--model", ring.model)
    assert (
        run("calibrate", ring.session, *body, "--protocol", ring.protocol, "-o", tmp_path / "cal", "--no-report") == 0
    )
    subject = load_subject(tmp_path / "cal")
    [script] = [each for each in real._compare_links("", "", files, mount) if each.method == "amekf"]
    own = {"seg2_and_seg3": 5e-4 * script.figures["seg2_and_seg3_mm"], "seg4": 1e-3 * script.figures["seg4_mm"]}
    for name, true in ring.true_lengths.items():
        value, std = subject.lengths[name], subject.std(name)
        print(
            f"{mount} {name}: {1e3 * value:.2f} ± {1e3 * std:.2f} mm, script {1e3 * own[name]:.2f}, "
            f"optical {1e3 * true:.2f}"
        )
        assert abs(value - true) < 3.0 * std
        assert abs(value - true) < (1.5e-3 if mount == "rigid" else 3e-3)
        assert abs(value - own[name]) < (2e-3 if mount == "rigid" else 6e-3)
        assert std < 2e-3
    assert json.loads((tmp_path / "cal" / "calibration.json").read_text())["quality"] == "pass"

    pages = ("--no-report", "--no-view")
    assert run("track", ring.session, *body, "--subject", tmp_path / "cal", "-o", tmp_path / "result", *pages) == 0
    pose = pl.read_parquet(tmp_path / "result" / "pose.parquet")
    time = pose["time"].to_numpy()
    inside = ring.known & (ring.time >= time[0]) & (ring.time <= time[-1])
    early = ring.time[inside] <= real.UNSCORED_S
    chain, registered = real._register_ring(files.folder)
    for segment in RING_SEGMENTS:
        quat = pose.select([f"{segment}_{c}" for c in ("qx", "qy", "qz", "qw")]).to_numpy()
        tracked, true = Slerp(time, Rotation.from_quat(quat))(ring.time[inside]), ring.true[segment][inside]
        tracked = align_rotation(tracked, true, early)
        by_command = attitude_error(tracked[~early], true[~early], ring.time[inside][~early])
        sensor, registration = chain.sensors[mount, segment], registered[mount, segment]
        noise = real.assume_noise(sensor.rate_hz, registration.gyro_bias)
        alone = dict(real._run_orientations(sensor, registration, noise))["amekf"]
        scored = alone.scored
        by_script = attitude_error(alone.estimated[scored], alone.true[scored], sensor.time[scored])
        print(f"{mount} {segment}: {by_command.total_rmse:.2f} deg, script {by_script.total_rmse:.2f} deg")
        # The joints make one chain of the five: a hinge takes the headings of both its links together.
        assert by_command.total_rmse < by_script.total_rmse + 2.0
        assert by_command.total_rmse < 3.5
