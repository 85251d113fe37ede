"""Standard deviations of matches by cause, against patterns and noise that are known."""

import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, correlate_points, prepare_current, prepare_reference
from ringdic.uncertainty.matches import MatchUncertainty, match_uncertainty
from ringdic.uncertainty.texture import Texture, texture_map

SIZE = 170
SPECKLES = np.random.default_rng(11).uniform(-20.0, SIZE + 20.0, (2, 420))
XY = np.stack(np.meshgrid(*[np.arange(60.0, 111.0, 10.0)] * 2), axis=-1).reshape(-1, 2)


def pattern(squeeze: float, about: float = 85.0) -> np.ndarray:
    """A formula's speckle image; x of the current image is ``about + squeeze (x - about)``, noise-free."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    x = about + (x - about) / squeeze
    image = np.full((SIZE, SIZE), 200.0)
    for cx, cy in SPECKLES.T:
        image -= 60.0 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 3.0**2))
    return image


@pytest.mark.parametrize("squeeze", [1.0, 0.6])
@pytest.mark.parametrize("order", [1, 2])
def test_over_repeated_noise_matches_scatter_as_their_two_parts_say(squeeze: float, order: int) -> None:
    settings = CorrelationSettings(radius=20, order=order)
    first, second = pattern(1.0), pattern(squeeze)
    noise, rng, trials = (3.0, 2.0), np.random.default_rng(2), 40
    start = np.zeros((len(XY), 6))
    start[:, 0], start[:, 2] = (squeeze - 1.0) * (XY[:, 0] - 85.0), squeeze - 1.0
    uv, stated = [], []
    for _ in range(trials):
        a, b = (image + rng.normal(0.0, s, image.shape) for image, s in zip((first, second), noise, strict=True))
        pair = prepare_reference(a, settings=settings), prepare_current(b, settings=settings)
        found = correlate_points(*pair, XY, settings, start=start, threads=1)
        textures = texture_map(a, 20).at(XY), texture_map(b, 20).at(XY + found.uv)
        parts = match_uncertainty(found.sigma, found.c_ls, textures, (noise[0] ** 2, noise[1] ** 2), found.gradient)
        G = np.eye(2) + found.gradient
        uv.append(found.uv)
        stated.append(np.einsum("nij,nj->ni", G**2, parts.reference**2) + parts.current**2)
    spread = np.nanstd(uv, axis=0, ddof=1)
    ratio = np.sqrt(np.nanmean(spread**2, axis=0) / np.nanmean(stated, axis=(0, 1)))
    assert np.isnan(uv).mean() < 0.06  # few stand out from their neighbours by chance
    # Thirty-six points of overlapping subsets and forty trials know it to 4 %; the model leaves the rest.
    assert (ratio > 0.88).all()
    assert (ratio < 1.14).all()


def test_what_the_noise_does_not_explain_is_systematic_and_what_it_does_is_not() -> None:
    texture = Texture(np.full(3, 40.0), np.tile([1e14, 0.0, 1e14], (3, 1)), np.full(3, 5.0))
    visible = (4.0 + 0.85 * 4.0) / 40.0**2
    c_ls, sigma = visible * np.array([1.0, 0.5, 3.0]), np.full((3, 2), 0.005)
    parts = match_uncertainty(sigma, c_ls, (texture, texture), (4.0, 4.0))
    np.testing.assert_allclose(parts.systematic[:2], 0.0, atol=1e-9)
    # Where all is noise its parts make up what was stated but for the share that the interpolation hides.
    np.testing.assert_allclose(parts.reference[0] ** 2 + 0.85 * parts.current[0] ** 2, sigma[0] ** 2, rtol=1e-9)
    # A residual below the noise that was told: the residual counts.
    np.testing.assert_allclose(parts.reference[1] ** 2 + 0.85 * parts.current[1] ** 2, sigma[1] ** 2, rtol=1e-9)
    # Two thirds of this residual are no noise; on the edges they count 5 times, of which a share remains.
    between = match_uncertainty(sigma, c_ls, (texture, texture), (4.0, 4.0), np.zeros((3, 2, 2)))
    for found, share in ((parts, 0.42), (between, 0.7)):
        np.testing.assert_allclose(found.systematic[2], sigma[2] * np.sqrt(share * 5.0 * 2.0 / 3.0), rtol=1e-9)
    np.testing.assert_allclose(parts.reference[2] ** 2 + 0.85 * parts.current[2] ** 2, sigma[2] ** 2 / 3, rtol=1e-9)


def test_a_lost_match_has_no_parts() -> None:
    texture = Texture(np.full(1, 40.0), np.array([[100.0, 0.0, 100.0]]), np.ones(1))
    parts = match_uncertainty(np.full((1, 2), np.nan), np.full(1, np.nan), (texture, texture), (4.0, 4.0))
    assert np.isnan(parts.reference).all()
    assert np.isnan(parts.current).all()
    assert np.isnan(parts.systematic).all()


def test_parts_of_different_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="one shape"):
        MatchUncertainty(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((2, 2)))
