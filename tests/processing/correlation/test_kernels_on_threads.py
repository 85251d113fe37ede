"""Ranges of work make the whole, each once, whatever the number of threads and pieces; an error ends the call."""

import numba
import numpy as np
import pytest
from ringdic.correlation.correlate import on_threads
from ringdic.correlation.parallel import in_ranges


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("count", "least"), [(0, 1), (1, 1), (7, 1), (1000, 1), (1000, 300), (1001, 1000)])
def test_every_piece_is_done_once(threads: int, count: int, least: int) -> None:
    if threads > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("there is one core")
    done = np.zeros(count, int)

    def kernel(first: int, last: int, out: np.ndarray) -> None:
        out[first:last] += 1

    with on_threads(threads):
        in_ranges(kernel, count, done, least=least)
    assert (done == 1).all()


def test_an_error_in_any_range_is_raised() -> None:
    def kernel(first: int, last: int) -> None:
        if last == 100:
            raise ValueError("the last range")

    with pytest.raises(ValueError, match="the last range"):
        in_ranges(kernel, 100)
