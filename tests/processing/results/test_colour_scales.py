"""Colours of field values: order, ends, middle, and what was not measured."""

import numpy as np
from ringdic.results.colours import UNMEASURED, colours


def lightness(rgb: np.ndarray) -> np.ndarray:
    """CIE L* of sRGB colours."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    Y = linear @ [0.2126, 0.7152, 0.0722]
    return 116 * np.where(Y > 0.008856, np.cbrt(Y), 7.787 * Y + 16 / 116) - 16


def test_a_sequential_scale_rises_evenly_in_lightness() -> None:
    L = lightness(colours(np.linspace(2.0, 5.0, 101), 2.0, 5.0))
    steps = np.diff(L)
    assert (steps > 0).all()
    assert steps.max() < 2.5 * steps.min()
    assert L[0] < 25
    assert L[-1] > 85


def test_a_diverging_scale_is_even_about_a_pale_middle() -> None:
    rgb = colours(np.linspace(0.9, 1.1, 101), 0.9, 1.1, diverging=True)
    L = lightness(rgb)
    assert L[50] == L.max() > 90
    np.testing.assert_allclose(L, L[::-1], atol=12)
    assert rgb[0, 2] > 2 * rgb[0, 0]  # blue below
    assert rgb[-1, 0] > 2 * rgb[-1, 2]  # red above
    assert np.ptp(rgb[50]) < 0.05


def test_values_beyond_the_limits_keep_the_end_colours_and_unknown_ones_are_grey() -> None:
    for diverging in (False, True):
        found = colours(np.array([[-9.0, 0.0], [1.0, 9.0], [np.nan, np.inf]]), 0.0, 1.0, diverging)
        assert found.shape == (3, 2, 3)
        np.testing.assert_array_equal(found[0, 0], found[0, 1])
        np.testing.assert_array_equal(found[1, 0], found[1, 1])
        np.testing.assert_array_equal(found[2], [UNMEASURED, UNMEASURED])
        assert ((found >= 0) & (found <= 1)).all()
