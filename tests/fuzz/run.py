"""Coverage-guided fuzzing of all that is parsed, by atheris: ``python tests/fuzz/run.py [TARGET …] --seconds 60``.

Each target runs in a process of its own, from the seeds and what earlier runs came upon (``.fuzz/corpus``), and goes on
after a finding; the input of each different one is kept in ``.fuzz/found``, and the exit code is 1. With ``--runs`` and
``--seed`` a run is the same every time. The table says of each target how many inputs were tried, how many different
findings there were, and the edges and features that libFuzzer counts over all of wepose.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import re
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
LONGEST = 1 << 16  # [bytes] of an input
MEMORY_MB, SECONDS_EACH = 2048, 20
MOST_FOUND = 10  # different findings of a target; then it ends
ALL = "all"  # one process, the first byte says which target
HEADER = f"{'target':<12} {'inputs':>8} {'found':>5} {'edges':>6} {'features':>8}"


def compiled_modules() -> list[str]:
    """Modules with functions that numba compiles, and cannot once atheris has changed them."""
    files = (
        path
        for path in (ROOT / "wepose_pin").rglob("*.py")
        if re.search(r"^@?\w*(kernel|compiled|inlined)\b", path.read_text(encoding="utf-8"), re.MULTILINE)
    )
    return [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in files]


def fuzz(name: str, arguments: list[str], prefix: str, base: Path) -> None:
    """Fuzz one target, or all by turns, in this process; never returns. Files of findings begin with `prefix`.

    `base` is an empty folder to work in, which libFuzzer leaves as it ends.
    """
    import atheris
    from fuzz.target import try_one

    with atheris.instrument_imports(include=["wepose_pin", "tomllib"], exclude=compiled_modules()):
        from fuzz.targets import TARGETS

        targets = [target for target in TARGETS if name in (ALL, target.name)]
        for target in targets:
            importlib.import_module(f"wepose_pin.{target.module}")
    seen: set[str] = set()
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
        target, whole = targets[0], data
        if name == ALL:
            target, data = targets[data[0] % len(targets)] if data else target, data[1:]
        try:
            try_one(target, work / target.name, data)
        except Exception as error:
            key = _where(error)
            if key not in seen:
                seen.add(key)
                file = Path(f"{prefix}{hashlib.sha256(key.encode()).hexdigest()[:12]}")
                file.write_bytes(whole)
                print(f"FOUND {key}\n{file}", file=sys.stderr, flush=True)
            if len(seen) >= MOST_FOUND:
                raise

    # Seeds that were given first are where new inputs are kept.
    atheris.Setup(["fuzz", *arguments, *([f"-dict={words}"] if listed else []), str(corpus)], one)
    atheris.Fuzz()


def _where(error: BaseException) -> str:
    """What tells findings apart: the kind of error, and the innermost lines of wepose on its way."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if "wepose_pin" in frame.filename]
    places = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in own[-2:]]
    return f"{type(error).__name__} {' '.join(str(error).split())[:160] if not own else ''}{' > '.join(places)}".strip()


# From the command line ---------------------------------------------------------------------------------------------


def run(name: str, options: argparse.Namespace) -> int:
    """One target, begun again where an input ends the whole process, and its row of the table; how much it found."""
    corpus, findings = options.out / "corpus" / name, options.out / "found"
    corpus.mkdir(parents=True, exist_ok=True)
    findings.mkdir(exist_ok=True)
    begin = f"import sys; sys.path[:0] = {sys.path[:2]!r}; from fuzz import run"
    inputs = edges = features = died = 0
    notes: list[str] = []
    until = time.monotonic() + options.seconds
    while True:
        left = max(1, round(until - time.monotonic()))
        limits = [
            f"-max_total_time={left}",
            f"-runs={options.runs}",
            f"-seed={options.seed + died if options.seed else 0}",
        ]
        limits += [f"-max_len={LONGEST}", f"-rss_limit_mb={MEMORY_MB}", f"-timeout={SECONDS_EACH}"]
        limits += [f"-artifact_prefix={findings}/{name}-", "-len_control=20"]
        with tempfile.TemporaryDirectory(prefix="wepose-fuzz-") as base:
            arguments = [*limits, str(corpus)]
            code = f"{begin}; run.fuzz({name!r}, {arguments!r}, {f'{findings}/{name}-'!r}, run.Path({base!r}))"
            ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, errors="replace")
        tried = re.findall(r"^#(\d+)\s.*cov: (\d+) ft: (\d+)", ended.stderr, re.MULTILINE)
        done = re.findall(r"^(?:#|Done )(\d+)", ended.stderr, re.MULTILINE)
        inputs += int(done[-1]) if done else 0
        edges, features = (
            max(old, int(new)) for old, new in zip((edges, features), tried[-1][1:] if tried else (0, 0), strict=True)
        )
        notes += re.findall(r"^FOUND (.*)", ended.stderr, re.MULTILINE)
        if not ended.returncode:
            break
        died += 1
        said = [
            line
            for line in (ended.stdout + ended.stderr).splitlines()
            if line.strip() and not line.startswith(("#", "INFO"))
        ]
        notes.append("the process ended: " + "\n    ".join(said[-12:]))
        if not tried or died >= MOST_FOUND or time.monotonic() > until - 2:
            break
    notes = list(dict.fromkeys(notes))
    print(f"{name:<12} {inputs:>8} {len(notes):>5} {edges:>6} {features:>8}", flush=True)
    for note in notes:
        print(f"    {note}", flush=True)
    return len(notes)


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
    print(HEADER, flush=True)
    return 1 if sum([run(name, options) for name in options.targets]) else 0


if __name__ == "__main__":
    sys.exit(main())
