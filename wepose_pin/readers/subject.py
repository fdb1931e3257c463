"""A subject from its own file, or from a recording that has the lengths of a body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..body.subject import Subject, load_subject, population_subject
from .mvnx import LENGTH_STD, read_mvnx_lengths


def read_subject(path: Path) -> Subject:
    """Read ``subject.toml``, the folder that holds it, or the lengths in an Xsens MVNX.

    MVN's lengths are taken as they are, with the standard deviation `LENGTH_STD`; the others are those that people with
    these have.

    Raises
    ------
    MissingFile, BadSubject, BadData
        Not there; a subject that is none; no lengths in the MVNX.
    """
    if path.suffix.lower() != ".mvnx":
        return load_subject(path)
    lengths = read_mvnx_lengths(path)
    prior = population_subject()
    known = np.array([name in lengths for name in prior.order])
    mean = np.array([prior.lengths[name] for name in prior.order])
    cov = prior.covariance
    # Regression of the others on those that are known, with their errors.
    gain = cov[:, known] @ np.linalg.inv(cov[np.ix_(known, known)] + LENGTH_STD**2 * np.eye(known.sum()))
    gain[known] = np.eye(known.sum())
    mean = mean + gain @ (np.array([lengths[name] for name in prior.order if name in lengths]) - mean[known])
    left = np.eye(len(known))
    left[:, known] -= gain
    covariance = left @ cov @ left.T + LENGTH_STD**2 * gain @ gain.T
    return replace(
        prior,
        name=path.stem,
        lengths=dict(zip(prior.order, mean.tolist(), strict=True)),
        covariance=0.5 * (covariance + covariance.T),
        note=f"lengths of {path.name}; the others are those of people with these",
    )
