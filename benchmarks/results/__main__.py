"""`python -m benchmarks.results`: save what the commands compute, and compare two such folders."""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # the last bits of BLAS depend on its number of threads. Before numpy loads.

import argparse
import sys
from pathlib import Path

from .comparison import Folder, WrongUsage, compare, print_comparison, read_renames
from .saving import save


def _folder_of_data() -> Path | None:
    named = os.environ.get("WEPOSE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "data"
    return folder.resolve() if folder.is_dir() else None


def main() -> int:
    """The exit code: 0; 1 where results differ or a task failed; 2 on wrong usage."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.results", description="Have results changed?")
    commands = parser.add_subparsers(dest="command", required=True)
    saving = commands.add_parser("save", help="store what the commands compute")
    saving.add_argument("folder", type=Path, help="a new folder")
    saving.add_argument("--inputs", type=Path, help="recordings of another run (its inputs/) in place of new ones")
    saving.add_argument("--only", default="*", metavar="PATTERN", help="only tasks of such names, as 'mild/*'")
    saving.add_argument("--jobs", type=int, default=2, help="processes (2)")
    comparing = commands.add_parser("compare", help="hold two folders of `save` against each other, bit for bit")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    comparing.add_argument("--renames", type=Path, metavar="TOML", help="[renames] and [reasons] of keys, by patterns")
    comparing.add_argument("--only", default="*", metavar="PATTERN", help="only such keys, as 'track/mild/*'")
    comparing.add_argument("--most", type=int, default=30, help="so many keys of each kind are listed (30)")
    given = parser.parse_args()
    try:
        if given.command == "save":
            return save(given.folder, given.inputs, _folder_of_data(), given.only, given.jobs)
        renames = read_renames(given.renames)
        found = compare(Folder(given.old), Folder(given.new), renames, given.only)
    except WrongUsage as error:
        print(f"benchmarks.results: {error}", file=sys.stderr)
        return 2
    print_comparison(found, given.most)
    return int(not found.same)


if __name__ == "__main__":
    sys.exit(main())
