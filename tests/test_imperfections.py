"""Imperfections of simulated sensors, and switches: sizes as documented, each independent of the others."""

from dataclasses import fields, replace

import numpy as np
import pytest
from simulated import SEGMENTS, SUBJECT

from wepose_pin import IDEAL_PRESET, PEOPLE_PRESET, Imperfections, Simulation, simulate

SHORTER = {"clasp_s": 5.0, "circles": 0, "rate_hz": 30.0}
# Of the body: imperfection -> it turns segments, and not only sensors on them.
BODY = {"tissue_gain": False, "tissue_random": False, "sensor_place": False}
BODY |= dict.fromkeys(("girdle", "elbow", "wrists", "start_pose", "sway", "palm_slip", "start_heading_deg"), True)
ON = [f.name for f in fields(Imperfections) if getattr(PEOPLE_PRESET, f.name) != getattr(IDEAL_PRESET, f.name)]


@pytest.fixture(scope="module")
def people() -> Simulation:
    return simulate(SUBJECT, seed=5, imperfections=PEOPLE_PRESET, **SHORTER)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"palm_slip": -0.001}, r"palm_slip = -0\.001"),
        ({"mount": "some"}, "mount = 'some'"),
        ({"bits": 16}, "bits 16 need a finite"),
        ({"gyro_range_deg_s": 0.0}, "gyro_range_deg_s"),
        ({"dropped": 0.5}, r"dropped = 0\.5"),
        ({"sway": np.nan}, "sway = nan"),
        ({"girdle": -1.0}, "girdle = -1"),
        ({"sensor_place": 1.5}, r"sensor_place = 1\.5"),
    ],
)
def test_wrong_sizes_are_named(wrong: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Imperfections(**wrong)
    with pytest.raises(ValueError, match="clock_jitter"):
        simulate(SUBJECT, seed=0, imperfections=Imperfections(clock_jitter=0.01), clasp_s=5.0, circles=0)


def sensor_draws(sim: Simulation) -> dict[str, np.ndarray]:
    eye = np.eye(3, dtype=bool)
    gyro, accel = (np.stack([getattr(d, f"{n}_matrix") for d in sim.device.values()]) for n in ("gyro", "accel"))
    clock = np.stack(list(sim.sample_time.values())) - sim.time
    drift = clock[:, -1] - clock[:, 0]
    return {
        "noise": np.stack(list(sim.accel_bias.values())),
        "mount": np.stack(list(sim.quat_LS.values())),
        "gyro_scale": gyro[:, eye],
        "accel_scale": accel[:, eye],
        "misalignment_deg": np.stack((gyro[:, ~eye], accel[:, ~eye])),
        "g_sensitivity_deg_s": np.stack([d.g_matrix for d in sim.device.values()]),
        "gyro_warm_up_deg_s": np.stack([d.warm_up for d in sim.device.values()]),
        "clock_jitter": np.std(np.diff(clock, axis=1), axis=1).round(6),
        "clock_offset": clock.mean(axis=1).round(4),
        "clock_drift_ppm": drift,
        "dropped": np.stack([np.isnan(v) for v in sim.gyro_S.values()]),
    }


@pytest.mark.parametrize("name", [*ON, "mount"])
def test_switching_one_off_leaves_the_others_as_they_are(people: Simulation, name: str) -> None:
    changes = {name: "any" if name == "mount" else getattr(IDEAL_PRESET, name)}
    if "range" in name:
        changes["bits"] = 0  # which need a range
    without = simulate(SUBJECT, seed=5, imperfections=replace(PEOPLE_PRESET, **changes), **SHORTER)
    less = sensor_draws(without)
    for other, values in sensor_draws(people).items():
        if other == name:
            assert not np.array_equal(values, less[other]), other
        elif not (other.startswith("clock") and name.startswith("clock")):
            np.testing.assert_allclose(less[other], values, atol=2e-12)
    skeleton = all(np.array_equal(without.quat_WL[segment], people.quat_WL[segment]) for segment in SEGMENTS)
    assert skeleton != BODY.get(name, False)
    for segment in SEGMENTS:
        if name not in BODY and not name.startswith("clock"):
            assert np.array_equal(without.soft_tissue[segment], people.soft_tissue[segment])
        placed = name == "sensor_place" and segment != "torso"
        assert np.array_equal(without.p_LS[segment], people.p_LS[segment]) != placed
