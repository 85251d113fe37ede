"""Choice of the distortion terms of a lens: as many as the views of the board determine, or as few as explain them.

The first is the safe choice: a needless term costs little, and its uncertainty is propagated. For the second, models
are compared by Akaike's information criterion ``N ln(Σ r² / N) + 2 k`` (1974) over the same corners, k the number of
free terms. Residuals of neighbouring corners are correlated by the bend of the board and by blur, so the n corners are
fewer independent observations: N = 2 n ((1 − ρ) / (1 + ρ))², with the correlation ρ of neighbours, as for a first-order
autoregressive process along both edges of the board.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ringdic.arrays import Floats, Mask, Pixels

#: Fewest independent observations of a view, however strongly its residuals are correlated: one corner and a half.
_FEWEST_PER_VIEW = 3.0


@dataclass(frozen=True)
class LensModel:
    """Free terms of a lens: number of radial terms, 2 or 3, and whether the tangential pair and the skew are free."""

    radial: int
    tangential: bool = True
    skew: bool = True

    def __post_init__(self) -> None:
        if self.radial not in (2, 3):
            raise ValueError(f"a lens has 2 or 3 radial terms, not {self.radial}")

    @property
    def free(self) -> Mask:
        """Which of the parameters fx fy s cx cy k1 k2 p1 p2 k3 are free, (10,) bool."""
        t = self.tangential
        return np.array([True, True, self.skew, True, True, True, True, t, t, self.radial == 3])

    def __str__(self) -> str:
        parts = [f"{self.radial} radial terms"]
        parts += ["tangential"] if self.tangential else []
        parts += ["skew"] if self.skew else []
        return ", ".join(parts)


def candidate_models(radial: int | None, tangential: bool, skew: bool, fewest: bool) -> list[LensModel]:
    """Lens models to choose from, the one with the most terms first.

    radial : number of radial terms, None for 3 or 2. tangential, skew : False excludes these terms. fewest : also
    models that lack some of the allowed terms.
    """
    radials = (3, 2) if radial is None or (fewest and radial == 3) else (radial,)
    if not fewest:
        return [LensModel(each, tangential, skew) for each in radials]
    either = (True, False)
    return [
        LensModel(*terms)
        for terms in itertools.product(radials, either if tangential else (False,), either if skew else (False,))
    ]


@dataclass(frozen=True)
class LensModelChoice:
    """The chosen lens model and the reason for it, in words for the operator."""

    model: LensModel
    reason: str


def independent_observations(residuals: Pixels, board_xy: Floats) -> float:
    """Number of independent observations in correlated residuals of corners.

    residuals : (v, n, 2) px, of n corners in v views. board_xy : (n, 2) mm, the corners on the board.
    """
    distance, _ = scipy.spatial.cKDTree(board_xy).query(board_xy, k=2)
    pitch = float(np.median(distance[:, 1]))
    pairs = scipy.spatial.cKDTree(board_xy).query_pairs(1.2 * pitch, output_type="ndarray")
    if not len(pairs):
        return float(residuals.size)
    power = float(np.mean(residuals**2))
    alike = float(np.mean(residuals[:, pairs[:, 0]] * residuals[:, pairs[:, 1]])) / power if power > 0 else 0.0
    alike = min(max(alike, 0.0), 0.99)
    worth = residuals.size * ((1 - alike) / (1 + alike)) ** 2
    return max(worth, _FEWEST_PER_VIEW * len(residuals))


def choose_model(
    models: list[LensModel], fit: Callable[[LensModel], tuple[float, float]], N: float, limit: float, fewest: bool
) -> LensModelChoice:
    """Choose a lens model: the first one that the views determine, or the one of the least information criterion.

    Parameters
    ----------
    models : to choose from, the one with the most terms first.
    fit : fits a model and returns its mean square residual per component, px², and the standard error of k3.
    N : number of independent observations.
    limit : a model whose k3 has a larger standard error is not determined by the views.
    fewest : True compares all determined models by the criterion, False takes the first.
    """
    if len(models) == 1:
        return LensModelChoice(models[0], "as set")
    scores: list[tuple[float, LensModel]] = []
    unsure = ""
    for model in models:
        square, k3_sigma = fit(model)
        if model.radial == 3 and not k3_sigma <= limit:
            unsure = f"; a third radial term would be known to ± {k3_sigma:.2f} only"
        elif fewest:
            scores.append((N * math.log(max(square, 1e-18)) + 2 * int(model.free.sum()), model))
        else:
            return LensModelChoice(model, f"the most terms that the views determine{unsure}")
    scores.sort(key=lambda each: each[0])
    if len(scores) == 1:
        return LensModelChoice(scores[0][1], f"the most terms that the views determine{unsure}")
    (best, model), (second, other) = scores[:2]
    return LensModelChoice(model, f"information criterion {second - best:.1f} below that of {other}{unsure}")
