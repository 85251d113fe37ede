"""Numbers in the names of image files, by which the frames of several cameras can be told to belong together."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import PurePath

_LARGEST = 99_999  # of a number that counts frames; larger ones are times and dates
_ALIKE = 0.5  # share of the numbers that two cameras have in common, above which they count alike


@dataclass(frozen=True)
class NumberConflict:
    """Two cameras whose files are numbered differently.

    cameras : their ids. only : for each the numbers that the other lacks. shift : by which all numbers of the second
    are larger than those of the first, 0 where they differ in another way.
    """

    cameras: tuple[str, str]
    only: tuple[tuple[int, ...], tuple[int, ...]]
    shift: int


def frame_numbers(names: Sequence[str]) -> list[int] | None:
    """Frame number of each of a camera's files: the last number in their names that is not the same in all.

    names : of the files, in natural order. None for fewer than two files, where the names differ in more than their
    numbers, and where those do not count frames, as times of the day.
    """
    parts = [re.split(r"(\d+)", PurePath(name).stem) for name in names]
    if len(parts) < 2 or len({tuple(each[::2]) for each in parts}) > 1:
        return None
    varying = [k for k in range(1, len(parts[0]), 2) if len({int(each[k]) for each in parts}) > 1]
    if not varying:
        return None
    numbers = [int(each[varying[-1]]) for each in parts]
    rising = all(first < second for first, second in pairwise(numbers))
    return numbers if rising and numbers[-1] <= _LARGEST else None


def number_conflict(names: Mapping[str, Sequence[str]]) -> NumberConflict | None:
    """The first two cameras whose files count frames alike, but not the same ones; None where all agree.

    Counters may start at different numbers, as long as the ranges of numbers do not overlap.

    names : of the files of each camera, in natural order.
    """
    numbers = {camera: frame_numbers(each) for camera, each in names.items()}
    known = {camera: each for camera, each in numbers.items() if each is not None}
    for (camera, first), (other, second) in combinations(known.items(), 2):
        shift, common = _best_shift(first, second)
        if common == len(first) == len(second):
            overlapping = first[0] <= second[-1] and second[0] <= first[-1]
            if shift and overlapping:
                return NumberConflict((camera, other), _only(first, second, 0), shift)
        elif common > _ALIKE * len(first) or (not shift and common):
            return NumberConflict((camera, other), _only(first, second, shift), 0)
    return None


def _best_shift(first: Sequence[int], second: Sequence[int]) -> tuple[int, int]:
    """The shift of the second camera's numbers by which most agree with the first's, and how many do."""
    counts = Counter(b - a for a in first for b in second)
    shift = min(counts, key=lambda each: (-counts[each], each != 0, each != second[0] - first[0], abs(each)))
    return shift, counts[shift]


def _only(first: Sequence[int], second: Sequence[int], shift: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Numbers that one camera has and the other lacks, of each, after the second's are shifted back."""
    one, other = set(first), {number - shift for number in second}
    return tuple(sorted(one - other)), tuple(sorted(number + shift for number in other - one))


def shifted_numbers(conflict: NumberConflict) -> str:
    """The sentence about two cameras whose numbers are shifted."""
    one, other = conflict.cameras
    return (
        f"all file numbers of camera {other} are {abs(conflict.shift)} {'above' if conflict.shift > 0 else 'below'} "
        f"those of camera {one} that they are paired with; check that they show the same moments, and number them alike"
    )
