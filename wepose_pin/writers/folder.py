"""The folder of a result or a data set, which may hold an earlier one, or files of the user."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..body.table_file import MODEL_TABLE
from ..documents import whole_folder
from ..errors import ExistingOutput
from .provenance import INSIDE, list_files
from .result import JOINTS


@contextmanager
def data_folder(out: Path, force: bool, earlier: Sequence[str]) -> Iterator[Path]:
    """`whole_folder` of a data set: with `force` files of an earlier one, by their patterns, go; all others stay."""
    with whole_folder(out, force) as folder:
        yield folder
        written = {path.relative_to(folder) for path in folder.rglob("*")}
    for path in [path for pattern in earlier for path in out.glob(pattern)]:
        if path.relative_to(out) not in written:
            path.unlink()


@contextmanager
def result_folder(out: Path, force: bool) -> Iterator[Path]:
    """`data_folder` of a result; of an earlier result in `out` those files go that would be read with the new one.

    Raises
    ------
    ExistingOutput
        As `whole_folder`; a session in `out` needs a file that would be replaced; a file of the user's would be read
        with the result.
    """
    inputs = set()
    if (out / "session.toml").is_file():
        inputs = {file.resolve() for file in list_files(out, truth=True)}
    has_result = any((out / name).is_file() for name in INSIDE)
    for name in (MODEL_TABLE, JOINTS):
        if not has_result and (out / name).exists():
            raise ExistingOutput(
                f"{out / name}: is of no earlier result, and would be read with the new one; rename it, or name "
                f"another folder by -o"
            )
    stale = [name for name in (MODEL_TABLE, JOINTS) if has_result and (out / name).resolve() not in inputs]
    with data_folder(out, force, stale) as folder:
        yield folder
        for name in sorted(file.name for file in folder.iterdir()):
            if (out / name).resolve() in inputs:
                raise ExistingOutput(
                    f"{out / name}: is an input of {out / 'session.toml'}, and would be replaced; name another folder "
                    f"by -o"
                )
