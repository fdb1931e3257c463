"""Coverage-guided fuzzing of all that is parsed, by atheris: ``python tests/fuzz/run.py [TARGET …] --seconds 60``.

Each target runs in a process of its own, from the seeds and what earlier runs came upon (``.fuzz/corpus``). A finding
is kept in ``.fuzz/found``, and the exit code is 1. With ``--runs`` and ``--seed`` a run is the same every time.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
WATCHED = (
    "readers",
    "model",
    "subject",
    "errors",
    "live.sources",
    "calibration.protocols",
    "retargeting.maps",
    "writers.result",
)
# numba compiles these, and cannot what atheris makes of them.
NOT_WATCHED = ("so3", "static", "pose", "filters", "tracking", "readers.arrivals", "retargeting.limits")
LONGEST = 1 << 16  # [bytes] of an input
MEMORY_MB, SECONDS_EACH = 2048, 20
ALL = "all"  # one process, the first byte says which target


def fuzz(name: str, arguments: list[str]) -> None:
    """Fuzz one target, or all by turns, in this process; never returns."""
    import atheris

    with atheris.instrument_imports(
        include=[f"wepose_pin.{room}" for room in WATCHED] + ["tomllib"],
        exclude=[f"wepose_pin.{room}" for room in NOT_WATCHED],
    ):
        import wepose_pin.calibration.protocols
        import wepose_pin.live.sources.lsl
        import wepose_pin.live.sources.packets
        import wepose_pin.live.sources.xbus
        import wepose_pin.model.robot
        import wepose_pin.readers.describe
        import wepose_pin.retargeting.maps
        import wepose_pin.writers.result  # noqa: F401
    from fuzz.targets import TARGETS, try_one

    targets = [target for target in TARGETS if name in (ALL, target.name)]
    with tempfile.TemporaryDirectory(prefix="wepose-fuzz-") as made:
        base = Path(made)
        corpus, words, work = base / "seeds", base / "words", base / "work"
        corpus.mkdir()
        work.mkdir()
        for i, target in enumerate(targets):
            (work / target.name).mkdir()
            for k, seed in enumerate(target.seeds()):
                try_one(target, work / target.name, seed)  # what numba compiles it compiles before the clock runs
                (corpus / f"{target.name}-{k}").write_bytes((bytes([i]) if name == ALL else b"") + seed)
        listed = {word for target in targets for word in target.words if len(word) < 128}
        words.write_text("".join('"' + "".join(f"\\x{b:02x}" for b in word) + '"\n' for word in sorted(listed)))

        def one(data: bytes) -> None:
            target = targets[0]
            if name == ALL:
                target, data = targets[data[0] % len(targets)] if data else target, data[1:]
            try_one(target, work / target.name, data)

        # Seeds that were given first are where new inputs are kept.
        atheris.Setup(["fuzz", *arguments, *([f"-dict={words}"] if listed else []), str(corpus)], one)
        atheris.Fuzz()


def main() -> int:
    """Run the targets one after another, and say how far each came."""
    from fuzz.targets import TARGETS

    known = [target.name for target in TARGETS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", default=known, help=f"of: {', '.join(known)}; or {ALL}, by turns")
    parser.add_argument("--seconds", type=int, default=60, help="a target")
    parser.add_argument("--runs", type=int, default=-1, help="inputs a target")
    parser.add_argument("--seed", type=int, default=0, help="of chance; 0: another one every time")
    parser.add_argument("--out", type=Path, default=ROOT / ".fuzz", help="corpus and findings")
    options = parser.parse_args()
    unknown = [name for name in options.targets if name not in (*known, ALL)]
    if unknown:
        parser.error(f"'{unknown[0]}' is no target; there is: {', '.join(known)}")
    failed = 0
    for name in options.targets:
        corpus, found = options.out / "corpus" / name, options.out / "found"
        corpus.mkdir(parents=True, exist_ok=True)
        found.mkdir(exist_ok=True)
        limits = [f"-max_total_time={options.seconds}", f"-runs={options.runs}", f"-seed={options.seed}"]
        limits += [f"-max_len={LONGEST}", f"-rss_limit_mb={MEMORY_MB}", f"-timeout={SECONDS_EACH}"]
        limits += [f"-artifact_prefix={found}/{name}-", "-len_control=20"]
        begin = f"import sys; sys.path[:0] = {sys.path[:2]!r}; from fuzz.run import fuzz"
        code = f"{begin}; fuzz({name!r}, {[*limits, str(corpus)]!r})"
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, errors="replace")
        tried = re.findall(r"^#(\d+)\s.*cov: (\d+)", run.stderr, re.MULTILINE)
        inputs, edges = tried[-1] if tried else ("0", "0")
        print(
            f"{name:<12} {inputs:>9} inputs  {edges:>6} edges  {'FOUND' if run.returncode else 'none found'}",
            flush=True,
        )
        if run.returncode:
            failed = 1
            print("\n".join([*run.stdout.splitlines()[-30:], *run.stderr.splitlines()[-12:]]), flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
