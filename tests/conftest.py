"""Fixtures: where the real recordings lie, and one simulated person that several tests look at."""

import fcntl
import hashlib
import os
import re
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

# Workers share the processors already: BLAS with threads of its own takes twice the processor time for the same result.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
# numba's cache does not see a change in a function of another file that was compiled into a caller: the tests keep one
# cache for each state of the sources. Set before anything imports numba.
_SOURCES = sorted((Path(__file__).resolve().parent.parent / "wepose_pin").rglob("*.py"))
_STATE = hashlib.sha256(
    b"".join(path.read_bytes() for path in _SOURCES if b"compiled" in path.read_bytes())
).hexdigest()
os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / f"wepose-pin-numba-{_STATE[:16]}")

from numba.core.compiler_lock import global_compiler_lock  # noqa: E402
from numba.core.dispatcher import Dispatcher  # noqa: E402

from wepose_pin import Person, Recording, Simulation, simulate, simulate_person  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("WEPOSE_DATA") or ROOT.parent / "shared" / "data")
_WITHOUT_DATA = "no real recordings at"


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the real recordings (`WEPOSE_DATA`, ``../shared/data`` by default); the test is skipped without it."""
    if not DATA.is_dir():
        pytest.skip(f"{_WITHOUT_DATA} {DATA}; WEPOSE_DATA names their folder")
    return DATA


@pytest.fixture(scope="session")
def person() -> Person:
    return simulate_person(3)


@pytest.fixture(scope="session")
def simulation(person: Person) -> Simulation:
    """A clasp of 40 s and four circles, with the noise of an MTi-3."""
    return simulate(person.lengths, seed=3, clasp_s=40.0, circles=4)


@pytest.fixture(scope="session")
def half_minute(simulation: Simulation) -> Recording:
    """The recording of its first half minute, start pose and clasp, for what does not depend on the length."""
    whole = simulation.recording("half a minute")
    start, ((begin, _),) = whole.phases["start"], whole.phases["clasp"]
    return replace(whole.cut(whole.span((0.0, 30.0))), phases={"start": start, "clasp": ((begin, 29.9),)})


# Kernels are compiled once -------------------------------------------------------------------------------------------

_compile = Dispatcher.compile


def _compile_in_one_process(dispatcher: Any, signature: Any) -> Any:
    """Compile a kernel while the other workers wait for it: then they find it in the cache."""
    if not dispatcher.py_func.__module__.startswith("wepose_pin.") or dispatcher.overloads.get(signature):
        return _compile(dispatcher, signature)
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__}"
    with global_compiler_lock, open(folder / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _compile(dispatcher, signature)


Dispatcher.compile = _compile_in_one_process


# What the core does without ------------------------------------------------------------------------------------------

OPTIONAL = ("daqp", "example-robot-data", "ezc3d", "h5py", "pyarrow", "pylsl", "pyxdf", "rosbags")
MISSING = [name for name in OPTIONAL if find_spec(name.replace("-", "_")) is None]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Skip a test that fails because an optional package is not installed."""
    try:
        return (yield)
    except Exception as error:
        for name in MISSING:
            if re.search(f"(install|install --no-deps) {name}|No module named '{name}'", str(error)):
                pytest.skip(f"{name} is not installed")
        raise


# What the suite costs ------------------------------------------------------------------------------------------------

_START = time.monotonic()
_LAST = pytest.StashKey[float]()
_WORKERS: dict[str, float] = {}


def processor_time() -> float:
    """Processor time of this process, all its threads, and the children that it waited for [s]."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    item.stash[_LAST] = processor_time()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report: pytest.TestReport = yield
    now = processor_time()
    report.processor_s, item.stash[_LAST] = now - item.stash[_LAST], now  # with xdist it travels to the controller
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["processor_s"] = processor_time()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: object) -> None:
    _WORKERS[node.gateway.id] = getattr(node, "workeroutput", {}).get("processor_s", 0.0)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [report for reports in terminalreporter.stats.values() for report in reports]
    skipped = [report for report in reports if _WITHOUT_DATA in str(getattr(report, "longrepr", ""))]
    processor: Counter[str] = Counter()
    for report in (report for report in reports if hasattr(report, "processor_s")):
        processor[report.nodeid] += report.processor_s
    total = sum(_WORKERS.values()) or processor_time()
    terminalreporter.section("what the suite costs")
    terminalreporter.write_line(f"tests skipped for want of the real recordings: {len(skipped)}")
    terminalreporter.write_line(f"wall time {time.monotonic() - _START:.0f} s, processor time {total:.0f} s")
    terminalreporter.write_line("the ten that take most processor time [s]:")
    for nodeid, seconds in processor.most_common(10):
        terminalreporter.write_line(f"{seconds:7.1f}  {nodeid}")
