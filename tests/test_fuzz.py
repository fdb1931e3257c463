"""Whatever a file or datagram holds, it is taken, or refused in one line.

What was found by it, each with what should happen: test_fuzz_found.py.
"""

import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from fuzz_targets import TARGETS, WORDS, Target, try_one

WORD = re.compile(rb'[\w.+-]+|"[^"]*"')
EXAMPLES = {"retarget": 8}  # of a target that takes its time


def spoil(target: Target, random: np.random.Generator) -> bytes:
    """A well-formed input with some edits: bits turned over, words put in or exchanged, lines doubled, ends cut off."""
    seeds = target.seeds()
    data = bytearray(seeds[random.integers(len(seeds))])
    for _ in range(random.integers(1, 6)):
        at = int(random.integers(len(data) + 1))
        word = WORDS[random.integers(len(WORDS))]
        edit = random.choice(["flip", "delete", "insert", "exchange", "double", "cut"])
        if edit == "flip" and at < len(data):
            data[at] ^= 1 << int(random.integers(8))
        elif edit == "delete":
            del data[at : at + int(random.choice([1, 2, 8, 64, 512]))]
        elif edit == "insert":
            data[at:at] = word
        elif edit == "exchange" and (spans := [match.span() for match in WORD.finditer(data)]):
            first, last = spans[random.integers(len(spans))]
            data[first:last] = word
        elif edit == "double" and (lines := bytes(data).splitlines(keepends=True)):
            data[at:at] = lines[random.integers(len(lines))]
        elif edit == "cut":
            del data[at:]
    return bytes(data)


@pytest.mark.fuzz
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_what_is_spoiled_is_taken_or_refused_in_one_line(target: Target, tmp_path: Path) -> None:
    random = np.random.default_rng(zlib.crc32(target.name.encode()))
    for _ in range(EXAMPLES.get(target.name, 60)):
        try_one(target, tmp_path, spoil(target, random))


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_what_the_spoiling_begins_with_is_well(target: Target, tmp_path: Path) -> None:
    for seed in target.seeds():
        assert try_one(target, tmp_path, seed) is None
