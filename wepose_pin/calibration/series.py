"""Several sessions of one person, calibrated into one subject.

Each session is solved by itself on the same prior, so that the order does not matter. Lengths and shoulders are those
of all sessions (`sessions`), the mounts those of the last one: sensors are strapped on anew from session to session.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..errors import BadSession
from ..filters import BEST
from ..model import BodyModel, convert_breadths
from ..recording import Recording
from ..subject import Subject, population_subject
from .lengths import MEASURED_STD, calibrate
from .protocols import Protocol
from .result import Calibration
from .sessions import fuse_sessions, separate_mounts

# Standard deviations between two sessions' whole arms, from which on they are not of one person. Nearly all of a
# session's error comes again in the next one: on simulated people two sessions differ by up to 0.5.
DIFFERENT = 2.0


def calibrate_sessions(
    recordings: Sequence[Recording],
    *,
    measured: Mapping[str, float] | None = None,
    prior: Subject | None = None,
    model: BodyModel | None = None,
    protocol: str | Protocol | None = None,
    method: str = BEST,
    measured_std: float = MEASURED_STD,
) -> list[Calibration]:
    """The calibration of each session; the last one's subject has the lengths and shoulders of all of them.

    Parameters as `calibrate`. A session whose sensors sit elsewhere than labelled adds nothing.

    Raises
    ------
    BadSession
        Two sessions differ by more than one person's do.
    WeposeError
        As `calibrate`.
    """
    earlier = prior if prior is not None and prior.start_pose_offset else None
    if earlier is not None:
        prior = separate_mounts(earlier, population_subject(body=model))
    calibrations = [
        calibrate(
            recording,
            measured=measured,
            prior=prior,
            model=model,
            protocol=protocol,
            method=method,
            measured_std=measured_std,
        )
        for recording in recordings
    ]
    used = [k for k, calibration in enumerate(calibrations) if not calibration.labels.moved]
    check_same_person([recordings[k].where() for k in used], [calibrations[k].subject for k in used])
    last, used = calibrations[-1], used if len(calibrations) - 1 in used else []
    subjects = [calibrations[k].subject for k in used]
    if earlier is not None and used:
        subjects = [earlier, *subjects]
    if len(subjects) > 1:
        table = last.model.table
        stated = convert_breadths(measured or {}, table, measured_std)
        fused = fuse_sessions(subjects, prior or population_subject(body=last.model), stated, table)
        calibrations[-1] = replace(last, subject=fused).state_quality()
    return calibrations


def check_same_person(places: Sequence[str], subjects: Sequence[Subject]) -> None:
    """Raise `BadSession` where the lengths of two sessions differ by more than those of one person.

    Parameters
    ----------
    places : of the sessions, as an error names them
    """
    for i, first in enumerate(subjects):
        for place, second in zip(places[i + 1 :], subjects[i + 1 :], strict=True):
            for side in ("left", "right"):
                names = [name for name in first.lengths if name.startswith(side)]
                if not set(names) <= set(first.order) & set(second.order):
                    continue
                of_first, of_second = (sum(subject.lengths[name] for name in names) for subject in (first, second))
                variances = [float(subject.lengths_covariance(names).sum()) for subject in (first, second)]
                std = float(np.sqrt(sum(variances)))
                if abs(of_first - of_second) > DIFFERENT * std:
                    raise BadSession(
                        f"{place}: the {side} arm is {1e3 * of_second:.0f} mm long and {1e3 * of_first:.0f} mm in "
                        f"{places[i]}, ± {1e3 * std:.0f} mm: these are not sessions of one person, or one of them went "
                        f"wrong; calibrate each by itself to see which"
                    )
