"""A subject from its own file, or from a recording that has the lengths of a body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..subject import Subject, load_subject, population_subject
from .mvnx import LENGTH_STD, read_mvnx_lengths


def read_subject(path: Path) -> Subject:
    """Read ``subject.toml``, the folder that holds it, or the lengths in an Xsens MVNX.

    MVN's lengths are taken to `LENGTH_STD`; the others are those that people with these have.

    Raises
    ------
    MissingFile, BadSubject, BadData
        Not there; a subject that is none; no lengths in the MVNX.
    """
    if path.suffix.lower() != ".mvnx":
        return load_subject(path)
    lengths = read_mvnx_lengths(path)
    prior = population_subject()
    rows = [prior.order.index(name) for name in lengths]
    cov = prior.covariance
    gain = cov[:, rows] @ np.linalg.inv(cov[np.ix_(rows, rows)] + LENGTH_STD**2 * np.eye(len(rows)))
    mean = np.array([prior.lengths[name] for name in prior.order])
    mean = mean + gain @ (np.array(list(lengths.values())) - mean[rows])
    covariance = cov - gain @ cov[rows]
    return replace(
        prior,
        name=path.stem,
        lengths=dict(zip(prior.order, mean.tolist(), strict=True)),
        covariance=0.5 * (covariance + covariance.T),
        note=f"lengths of {path.name}, to 1 cm; the rest of people with these",
    )
