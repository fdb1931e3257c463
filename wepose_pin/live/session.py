"""A live session: source, sensor setup, recording and outputs together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..body import BodyModel, load_table
from ..errors import ExistingOutput
from ..filters import BEST
from ..recording import ImuSensor, Recording
from ..recording.plausibility import find_unseen_rate
from ..tracking.heading_problem import CAUSAL_KNOT_S
from ..writers.live_log import LiveLog
from ..writers.result import versions
from .loop import LiveLoop, SessionSummary
from .setup import SensorSetup, check_mounts
from .sources.base import Source
from .sources.replay import ReplaySource
from .state import QUIT, Output, Status

CONNECT_S = 0.2  # [s] for which a source searches before the user is asked again


def run_session(
    source: Source,
    setup: SensorSetup,
    *,
    method: str = BEST,
    model: BodyModel | str | Path | None = None,
    record: str | Path | None = None,
    force: bool = False,
    outputs: Sequence[Output] = (),
    until: Callable[[], bool] = lambda: False,
) -> SessionSummary:
    """Open the source, track it to its end, close everything.

    Raises
    ------
    WeposeError
        No such source; a sensor whose mount is not known; an existing file.
    """
    setup, record = setup.as_recorded().with_model(model), None if record is None else Path(record)
    if record is not None and record.exists() and not force:
        raise ExistingOutput(f"{record}: exists; --force replaces it, --record names another file")
    check_mounts(source, setup)
    warm_up(method)  # before samples come
    if not open_and_wait(source, outputs, until):
        for output in outputs:
            output.close()
        return SessionSummary()
    log = None
    try:
        check_mounts(source, setup)
        header = setup.header(source.sensors, source.orientations) | {"method": method, "versions": versions()}
        if record is not None:
            log = LiveLog(record, header, force)
        loop = LiveLoop(
            source,
            setup,
            method=method,
            model=model,
            log=log,
            outputs=outputs,
            begin=float(source.recording.time[0]) if isinstance(source, ReplaySource) else None,
        )
    except BaseException:
        source.close()
        if log is not None:
            log.close()
        raise
    return loop.run(until)


def open_and_wait(source: Source, outputs: Sequence[Output], until: Callable[[], bool]) -> bool:
    """Open the source and show what it waits for; return False where the user ends that by a key.

    Raises `KeyboardInterrupt` where `until` returns True meanwhile, and `WeposeError` where there is no such source.
    """
    try:
        source.open()
        while not source.connect(CONNECT_S):
            message = f"Waiting for {source.describe_awaited()}."
            for output in outputs:
                output.status(Status("waiting", message, problems=dict(source.problems)))
            if until():
                raise KeyboardInterrupt
            if QUIT in [request for output in outputs for request in output.take_requests()]:
                source.close()
                return False
    except BaseException:
        source.close()
        raise
    return True


def warm_up(method: str) -> None:
    """Track a person who stands: compilation and reading of files must not delay the start pose, nor a correction."""
    n, rng, upright = 200 + round(200.0 * CAUSAL_KNOT_S), np.random.default_rng(0), np.array([0.0, 0.0, 0.0, 1.0])
    sensors = {
        name: ImuSensor(
            gyro_S=1e-3 * rng.standard_normal((n, 3)),
            accel_S=[0.0, 0.0, 9.81] + 1e-2 * rng.standard_normal((n, 3)),
            stated_quat_LS=upright,
        )
        for name in tuple(load_table().segments)[:5]
    }
    recording = Recording("warm", np.arange(n) / 100.0, 100.0, sensors, {"start": ((0.0, 1.9),)})
    find_unseen_rate(np.zeros((200, 3)), np.tile([0.0, 0.0, 9.81], (200, 1)), 100.0)
    source = ReplaySource(recording, math.inf)
    LiveLoop(source, SensorSetup.from_recording(recording), method=method).loop(lambda: False)
