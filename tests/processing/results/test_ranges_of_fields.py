"""The percentiles of a field's range are those of numpy, to the last place."""

import numpy as np
import pytest
from ringdic.results.ranges import percentiles

RNG = np.random.default_rng(5)


@pytest.mark.parametrize(
    "values",
    [
        RNG.normal(size=10_007),
        np.zeros(50),
        -np.ones(7),
        np.array([1.5]),
        np.array([-3.0, 2.0]),
        np.concatenate([RNG.normal(size=99), [np.nan, np.inf, -np.inf, -0.0, 0.0]]),
        np.exp(20 * RNG.normal(size=301)) * RNG.choice([-1, 1], 301),
    ],
    ids=["normal", "zeros", "one value", "one point", "two points", "not finite", "many orders"],
)
def test_percentiles_are_those_of_the_finite_values(values: np.ndarray) -> None:
    single = values.astype(np.float32)
    expected = np.percentile(single[np.isfinite(single)].astype(float), [0, 2, 98, 100])
    np.testing.assert_allclose(percentiles(single), expected, rtol=1e-14)


def test_nothing_finite_has_no_range() -> None:
    assert percentiles(np.full(5, np.nan, dtype=np.float32)) is None
