"""Calls functions of `opensim_peer` in a process of its own: OpenSim's casadi and ours cannot live in one."""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import pytest


@contextmanager
def start_opensim() -> Iterator[Callable[..., Any]]:
    """Yield what calls a function of `opensim_peer` by its name; skip where OpenSim is not installed."""
    if importlib.util.find_spec("opensim") is None:
        pytest.skip("OpenSim's Python package is not installed")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield lambda name, *args: pool.submit(ask_opensim, name, *args).result()
    assert "opensim" not in sys.modules


def ask_opensim(name: str, *args: Any) -> Any:
    """In that process."""
    return getattr(importlib.import_module("opensim_peer"), name)(*args)
