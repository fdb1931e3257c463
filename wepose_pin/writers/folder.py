"""The folder of a result, which may hold an earlier result, or files of the user."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..body.table_file import MODEL_TABLE
from ..documents import whole_folder
from ..errors import ExistingOutput
from .provenance import INSIDE, list_files
from .result import JOINTS


@contextmanager
def result_folder(out: Path, force: bool) -> Iterator[Path]:
    """`whole_folder` of a result; of an earlier result in `out` those files go that would be read with the new one.

    Raises
    ------
    ExistingOutput
        As `whole_folder`. There are such files but no result in `out`, or a session in `out` needs a file that would
        be replaced.
    """
    with whole_folder(out, force) as folder:
        inputs = _list_inputs(out)
        earlier = [out / name for name in (MODEL_TABLE, JOINTS) if (out / name).exists()]
        has_result = any((out / name).is_file() for name in INSIDE)
        for file in earlier:
            if file.resolve() in inputs or not has_result:
                raise ExistingOutput(
                    f"{file}: is no file of an earlier result, and would be replaced or read with the new one; move "
                    f"it, or name another folder by -o"
                )
        yield folder
        written = {file.name for file in folder.iterdir()}
        for name in sorted(written):
            if (out / name).resolve() in inputs:
                raise ExistingOutput(
                    f"{out / name}: is an input of {out / 'session.toml'}, and would be replaced; name another folder "
                    f"by -o"
                )
    for file in earlier:
        if file.name not in written:
            file.unlink(missing_ok=True)


def _list_inputs(out: Path) -> set[Path]:
    """What a session in the folder consists of."""
    if not (out / "session.toml").is_file():
        return set()
    return {file.resolve() for file in list_files(out, truth=True)}
