"""Ten random recordings of ordinary behaviour, and those that failed once (``tests/random_recordings/README.md``)."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from random_recordings.activities import ACTIVITIES, Scene, stand
from random_recordings.motion import Motion, draw_stance, draw_sway
from random_recordings.people import CORE, draw_person
from random_recordings.trial import try_seed

FOLDER = Path(__file__).parent / "random_recordings"
# Short ones that hold between them every method, most activities, clocks, faults and invariances.
TEN = (3, 18, 175, 193, 233, 415, 1021, 1110, 1167, 1168)
LONGEST = (3, 18, 193, 1021, 1110, 1168)
FAILED_ONCE = tomllib.loads((FOLDER / "regressions.toml").read_text(encoding="utf-8")).get("seed", [])


@pytest.mark.parametrize("seed", [pytest.param(k, marks=[pytest.mark.seeds] * (k in LONGEST)) for k in TEN])
def test_what_must_hold_of_every_recording(seed: int) -> None:
    report = try_seed(seed)
    assert not report.failures, f"{report.about}\n" + "\n".join(f"{f.oracle}: {f.message}" for f in report.failures)


@pytest.mark.seeds
@pytest.mark.parametrize("failed", FAILED_ONCE, ids=lambda failed: f"{failed['number']}-{failed['oracle'].split()[0]}")
def test_what_failed_once(failed: dict) -> None:
    report = try_seed(failed["number"])
    assert not report.failures, f"{report.about}\n" + "\n".join(f"{f.oracle}: {f.message}" for f in report.failures)


# The simulator itself ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ACTIVITIES)
def test_the_force_belongs_to_the_motion(name: str) -> None:
    """Force less gravity is the second derivative of the sensor's path, by other differences."""
    rng = np.random.default_rng(7)
    person = draw_person(rng)
    motion = Motion(
        person,
        [stand(Scene(rng, person, 0.0, 2.0)), ACTIVITIES[name][0](Scene(rng, person, 2.0, 12.0))],
        [0.0, 2.0],
        [1.0, 2.0],
        draw_sway(rng)[0],
        draw_stance(rng),
    )
    t = np.arange(1.0, 8.0, 1e-3)
    place = {segment: np.array([0.02, 0.01, -0.1]) for segment in CORE}
    R, force = motion.at_sensors(t, place)
    for segment in CORE:
        root = motion.angles(t)
        at = np.column_stack([root["root_x"], root["root_y"], root["root_z"]])
        at = at + motion.origins(t)[segment] + R[segment].apply(place[segment])
        acceleration = np.gradient(np.gradient(at, t, axis=0), t, axis=0)
        off = np.abs(force[segment] - [0, 0, 9.80665] - acceleration)[5:-5]
        assert np.quantile(off, 0.99) < 0.05  # [m/s²]; differences see a kink in the jerk otherwise
