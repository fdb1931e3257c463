"""HDF5 and MATLAB files: arrays by their path, as ``/imu/torso/gyro``, and single columns of them, ``/imu/gyro[0]``.

An array is (n,), (n, k) or (k, n) with n samples; the fields of a MATLAB struct are a path's parts. HDF5, and with it
MATLAB's v7.3, needs h5py, which is optional.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..errors import BadData, one_of
from ..libraries import check_file, import_library, library_errors

SUFFIXES = (".h5", ".hdf5", ".mat")
KIND = "an HDF5 or MATLAB file"
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
# A sensor's signal has at most so many columns.
MOST_COLUMNS = 16


def is_array_file(path: Path) -> bool:
    """Return whether the suffix is that of an HDF5 or MATLAB file."""
    return path.suffix.lower() in SUFFIXES


class ArrayFile:
    """The arrays of numbers in a file, with their `shapes` by path; those of an HDF5 file are read on demand."""

    def __init__(self, path: Path) -> None:
        check_file(path, KIND)
        with library_errors(path, KIND), path.open("rb") as file:
            start = file.read(520)
        self.path, self.shapes = path, dict[str, tuple[int, ...]]()
        self._loaded: dict[str, np.ndarray] = {}
        if HDF5_MAGIC in (start[:8], start[512:]):  # MATLAB puts 512 bytes of its own before it
            self._hdf5 = import_library("h5py", path, "HDF5 (MATLAB's v7.3 is too)")
            with library_errors(path, KIND), self._hdf5.File(path) as content:
                content.visititems(self._add_shape)
        else:
            self._loaded = {name: values for name, values in read_mat(path).items() if values.ndim}
            self.shapes = {name: values.shape for name, values in self._loaded.items()}
        if not self.shapes:
            raise BadData(f"{path}: no arrays of numbers in it")

    def _add_shape(self, name: str, node: Any) -> None:
        dtype = getattr(node, "dtype", None)  # a group has none
        if dtype is not None and dtype.kind in "fiu" and 1 <= len(node.shape) <= 2:
            self.shapes[f"/{name}"] = tuple(int(size) for size in node.shape)

    def table(self, places: Mapping[str, str]) -> pl.DataFrame:
        """Read columns by name, ``path`` of an array or ``path[k]``; `places`: name → what begins an error's text."""
        columns = {}
        for name, place in places.items():
            part = re.fullmatch(r"(.*)\[(\d+)\]", name)
            array, k = (part[1], int(part[2])) if part else (name, 0)
            values = self._read_array(self._find(array, place))
            if values.ndim == 2 and (values.shape[1] > MOST_COLUMNS or values.shape[0] == 1):
                values = values.T  # MATLAB's v7.3 transposes arrays
            values = values.reshape(len(values), -1)
            if k >= values.shape[1] or (part is None and values.shape[1] > 1):
                shape = f"one column of {self.path.name}, whose {array} has shape {values.shape}"
                raise BadData(f"{place}: {name} is not {shape}; name one as {array}[0]")
            columns[name] = np.ascontiguousarray(values[:, k])
        if len({len(values) for values in columns.values()}) > 1:
            listed = ", ".join(f"{name} {len(values)}" for name, values in columns.items())
            raise BadData(f"{self.path}: the arrays of a sensor and its time differ in length: {listed}")
        return pl.DataFrame(columns)

    def expand(self, name: str, width: int, place: str) -> list[str]:
        """List the `width` columns of an array."""
        shape = self.shapes[self._find(name, place)]
        if len(shape) != 2 or width not in shape:
            raise BadData(f"{place}: {name} in {self.path.name} has shape {shape}; (n, {width}) is needed")
        return [f"{name}[{k}]" for k in range(width)]

    def _find(self, name: str, place: str) -> str:
        path = "/" + name.replace(".", "/").strip("/")
        if path not in self.shapes:
            raise BadData(f"{place}: no array '{name}' in {self.path.name}; {one_of(self.shapes, path)}")
        return path

    def _read_array(self, path: str) -> np.ndarray:
        if path not in self._loaded:
            with library_errors(self.path, KIND), self._hdf5.File(self.path) as file:
                self._loaded[path] = np.asarray(file[path], dtype=float)
        return self._loaded[path]


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of numbers in a MATLAB file but for v7.3, without sides of length one; structs' fields are parts.

    Path → array (n,) or (n, k), or a single number, (). What is neither a number nor a struct of one element is passed
    over.
    """
    from scipy.io import loadmat

    with library_errors(path, KIND):
        content = loadmat(path, simplify_cells=True)
    arrays: dict[str, np.ndarray] = {}
    waiting = [(f"/{name}", value) for name, value in reversed(content.items()) if not name.startswith("__")]
    while waiting:
        place, value = waiting.pop()
        if isinstance(value, dict):
            waiting += [(f"{place}/{name}", part) for name, part in reversed(value.items())]
        elif isinstance(value, int | float | np.ndarray) and np.ndim(value) <= 2:
            array = np.asarray(value)
            if array.dtype.kind in "biuf":
                arrays[place] = array.astype(float)
    return arrays
