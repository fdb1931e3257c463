"""A subject from its own file, or from a recording that has the lengths of a body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..body.subject import Subject, load_subject, population_subject
from .mvnx import LENGTH_STD, read_mvnx_lengths


def read_subject(path: Path) -> Subject:
    """Read ``subject.toml``, the folder that holds it, or the lengths in an Xsens MVNX.

    MVN's lengths are taken as they are, with the standard deviation `LENGTH_STD`; the others are the population's.

    Raises
    ------
    MissingFile, BadSubject, BadData
        Not there; a subject that is none; no lengths in the MVNX.
    """
    if path.suffix.lower() != ".mvnx":
        return load_subject(path)
    lengths, prior = read_mvnx_lengths(path), population_subject()
    known = np.array([name in lengths for name in prior.order])
    variance = np.where(known, LENGTH_STD**2, 0.0)
    return replace(
        prior,
        name=path.stem,
        lengths={**prior.lengths, **lengths},
        covariance=np.where(known[:, None] | known, 0.0, prior.covariance) + np.diag(variance),
        note=f"lengths of {path.name}; the others are the population's",
    )
