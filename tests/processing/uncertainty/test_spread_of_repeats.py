"""The judge of stated uncertainties, on values whose spread was put in."""

import numpy as np
import pytest

from processing.uncertainty.repeated import shared_places, spread


def test_a_true_statement_has_the_ratio_one_and_a_false_one_its_error() -> None:
    rng = np.random.default_rng(0)
    sigma = np.broadcast_to(rng.uniform(0.5, 2.0, (400, 2)), (20, 400, 2))
    values = 7.0 + sigma * rng.normal(size=sigma.shape)
    found = spread(values, sigma * np.array([1.0, 2.0]))
    # 7600 degrees of freedom: a standard deviation is known to 0.8 %, a little less well with unlike places.
    np.testing.assert_allclose(found.ratio, [1.0, 0.5], rtol=0.04)
    assert 0.5 < found.whole < 1.0
    assert (found.places, found.repeats) == (400, 20)


def test_a_place_lost_once_is_left_out() -> None:
    values = np.random.default_rng(0).normal(size=(3, 5, 1))
    values[1, 2] = np.nan
    assert spread(values, np.ones((3, 5, 1))).places == 4
    with pytest.raises(ValueError, match="no place"):
        spread(np.full((3, 5, 1), np.nan), np.ones((3, 5, 1)))
    with pytest.raises(ValueError, match="repeats"):
        spread(np.ones((3, 5)), np.ones((3, 5)))


def test_places_of_runs_are_found_by_their_names() -> None:
    one, other = np.array([[1, 2], [3, 4], [5, 6]]), np.array([[5, 6], [7, 8], [1, 2]])
    first, second = shared_places([one, other])
    np.testing.assert_array_equal(one[first], other[second])
    assert len(first) == 2
