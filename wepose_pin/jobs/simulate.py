"""``wepose simulate``: a session whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ..errors import BadOption, one_of
from . import Progress, no_progress
from .fields import field_values

if TYPE_CHECKING:
    from ..simulation import Imperfections, Person

ACTIVITY_S = 40.0
PROTOCOL, SHORT_PROTOCOL = "clasp+t_pose", "clasp"
LEAST_S = 30.0  # from which on there is time for the T-pose
PROTOCOL_S = 60.0  # of what is done between start pose and circles
LONGEST_S = 7200.0
CIRCLES = 6  # drawn by the right hand after the protocol


@dataclass(frozen=True)
class SimulateJob:
    """Simulate the recording of a person with five sensors, or fifteen on the whole body, and its known truth.

    The person stands in the start pose, does the motion of the protocol, then draws circles with the right hand.
    The sensors have the noise and bias of an Xsens MTi-3. Continue with `wepose calibrate DIR --measured ...` and
    `wepose track DIR`; after an activity of the whole body with `wepose track DIR --model whole_body`.

    Parameters
    ----------
    out : DIR
        Write session.toml, recording.parquet, truth.parquet (columns as in pose.parquet) and subject.toml (the true
        lengths and mounts) to this folder.
    seed : NUMBER
        Sample the person and the motion by this seed.
    rate_hz : HZ
        Sample the sensors at this rate, 20 to 2000 Hz.
    protocol : NAME
        Simulate the motion of this calibration protocol (see `wepose calibrate --help`): clasp, t_pose, bow, or
        several of them joined by +. Without it clasp+t_pose, or clasp alone for less than 30 s.
    activity
        Simulate an activity in place of a protocol. Of the whole body, with sensors on pelvis, head, hands and legs
        too: walking on the spot (walk), sitting down and standing up (sit), running (run), or throwing overhand
        (throw). Of the upper body: reaches, rests and typing of both arms, hands apart (tasks). Of the imperfections of
        the body in --preset mild, an activity has only the soft-tissue artefacts.
    seconds
        Simulate this many seconds of the activity (without it 40) or of the protocol's motion (without it 60); at least
        5.
    preset
        Simulate only the sensors' noise and bias (ideal), or also small soft-tissue artefacts, slip, sway and sensor
        errors (mild), or all of these and more at the sizes of people in the literature (people): soft tissue that
        follows the joints, shoulders that move with the arms, start poses as people hold them, wrists that bend. Sizes
        and sources are in wepose_pin/simulation/imperfections.py.
    imperfection : NAME=VALUE
        Simulate one imperfection at this size; may be given several times. mount=any: arbitrary sensor mounting, which
        the session does not state. All others are numbers; 0 is off, inf for the two full scales. Of the body, rms:
        soft_tissue_deg, palm_slip [m] in the clasp, sway_deg_s, start_segment_deg (arm segments off the start pose);
        mean: start_elbow_deg (flexion in the start pose), shoulder_wander [m] (translation at 90 deg of elevation). Of
        the sensors, standard deviation: gyro_scale, accel_scale (of the scale factors, 0.01 is 1 %), misalignment_deg,
        g_sensitivity_deg_s (per g), clock_jitter [s], clock_offset [s]; full scale: gyro_range_deg_s, accel_range_g;
        bits: of a sample over the full scale; dropped: fraction of samples lost, at most 0.2. Of people, as a multiple
        of the size in the literature: tissue_gain (soft tissue that follows the joints), tissue_random (its random
        part), girdle (shoulders that follow the arms), girdle_person (how people differ in that), girdle_wander
        (shrugs and reaching), girdle_rest (place of the shoulders at rest), carrying_angle (of the elbow), start_pose
        (offsets of the start pose); others: breath_deg (pitch of the torso's sensor), creep_deg (a strap in 10 min),
        strap_slip_deg, wobble_deg (per g), upper_arm_place and forearm_place (of the sensor, share of the length),
        girdle_hysteresis (share of elevation), elbow_abduction_deg, start_heading_deg (torso against W), sway_tilt_deg,
        wrist_flexion_deg, wrist_deviation_deg, gyro_warm_up_deg_s (of the bias, in 15 min), clock_drift_ppm,
        accel_average (share of the sample interval over which the accelerometer averages).
    force
        Replace the files of an earlier run in DIR.
    """

    out: Path
    seed: int = 1
    rate_hz: float = 100.0
    protocol: str | None = None
    activity: Literal["walk", "sit", "tasks", "run", "throw"] | None = None
    seconds: float | None = None
    preset: Literal["ideal", "mild", "people"] = "ideal"
    imperfection: Mapping[str, float | str] = field(default_factory=dict)
    force: bool = False

    def check(self) -> None:
        """Raise `BadOption` where a number is out of its range, or an imperfection is none."""
        from ..calibration import load_protocol
        from ..simulation.sequence import find_task

        check_seed(self.seed)
        load_protocol(self.protocol or PROTOCOL)
        find_task(self.protocol or PROTOCOL)
        if not 20.0 <= self.rate_hz <= 2000.0:
            raise BadOption(f"--rate-hz {self.rate_hz:g}: between 20 and 2000 samples a second")
        if self.activity is not None and self.protocol is not None:
            raise BadOption(f"--activity {self.activity} with --protocol {self.protocol}: one of them; leave one out")
        if self.seconds is not None and not 5.0 <= self.seconds <= LONGEST_S:
            raise BadOption(f"--seconds {self.seconds:g}: between 5 and {LONGEST_S:g}")
        self.imperfections()

    def imperfections(self) -> Imperfections:
        """Those of the preset, with the sizes that were given."""
        from dataclasses import fields, replace

        from ..simulation import PRESETS

        sizes = PRESETS[self.preset]
        names = [each.name for each in fields(sizes)]
        for name, value in self.imperfection.items():
            option = f"--imperfection {name}={value}"
            if name not in names:
                raise BadOption(f"{option}: '{name}' is not an imperfection; {one_of(names, name, len(names))}")
            if name != "mount" and not isinstance(value, int | float):
                raise BadOption(f"{option}: '{value}' is not a number, as in {name}=0")
            if name == "bits" and not float(value).is_integer():
                raise BadOption(f"{option}: '{value}' is not a whole number, as in {name}=0")
            try:
                sizes = replace(sizes, **dict[str, Any]({name: int(value) if name == "bits" else value}))
            except BadOption as error:
                raise BadOption(f"{option}: {error}") from None
        return sizes


class SimulateOutcome(NamedTuple):
    """What came of a `SimulateJob`."""

    person: Person


def run_simulate(job: SimulateJob, progress: Progress = no_progress) -> SimulateOutcome:
    """Simulate a recording and write its folder, whole or not at all.

    Raises
    ------
    WeposeError
        What an option lacks, or a place that cannot be written.
    """
    from dataclasses import replace

    import numpy as np

    from ..documents import whole_folder
    from ..model import DEFAULT_BODY
    from ..simulation import (
        ACTIVITIES,
        MEASURED_STD,
        PEOPLE_MEASURED_STD,
        simulate,
        simulate_activity,
        simulate_person,
    )
    from ..subject import mount_rows, subject_toml
    from ..writers import write_session
    from ..writers.provenance import collect_provenance, write_provenance

    job.check()
    with whole_folder(job.out, job.force) as folder:
        progress("simulating a person", 0.0)
        measured_std = PEOPLE_MEASURED_STD if job.preset == "people" else MEASURED_STD
        body = ACTIVITIES[job.activity].body if job.activity else DEFAULT_BODY
        person = simulate_person(job.seed, measured_std, body)
        if job.activity:
            simulation = simulate_activity(
                job.activity,
                seed=job.seed,
                rate_hz=job.rate_hz,
                imperfections=job.imperfections(),
                seconds=ACTIVITY_S if job.seconds is None else job.seconds,
                lengths=person.lengths,
            )
        else:
            seconds = PROTOCOL_S if job.seconds is None else job.seconds
            simulation = simulate(
                person.lengths,
                seed=job.seed,
                rate_hz=job.rate_hz,
                imperfections=job.imperfections(),
                clasp_s=seconds,
                protocol=job.protocol or (PROTOCOL if seconds >= LEAST_S else SHORT_PROTOCOL),
                circles=CIRCLES,
            )
        turned = job.imperfections().start_heading_deg > 0.0  # tracking's W faces where the torso does
        truth = simulation.truth_facing_torso() if turned else simulation.truth()
        write_session(folder, simulation.recording(f"simulated-{job.seed}"), truth)
        order = (*simulation.lengths, *(row for segment in simulation.quat_LS for row in mount_rows(segment)))
        true = replace(
            person.prior,
            name="truth",
            lengths=person.lengths,
            girdles=simulation.girdles,
            mounts=simulation.quat_LS,
            order=order,
            covariance=np.zeros((len(order), len(order))),
            note="simulated: the true lengths and mounts",
        )
        (folder / "subject.toml").write_text(subject_toml(true), encoding="utf-8")
        write_provenance(folder, collect_provenance("simulate", field_values(job)))
    return SimulateOutcome(person)


def check_seed(seed: int) -> None:
    """Raise `BadOption` where a seed is negative."""
    if seed < 0:
        raise BadOption(f"--seed {seed}: a whole number from 0 on")
