"""The noise floor of a sheet at rest whose noise is known, and steps taken out of results."""

import numpy as np
import pytest
from ringdic.results.noise_floor import noise_floor
from ringdic.results.results import Matches, Results
from ringdic.results.series import select_steps

SIGMA, SHIFT, SIDE = 0.002, np.array([0.03, -0.01, 0.02]), 60


def sheet_at_rest() -> Results:
    """A plane grid of 1 mm, its reference exact: step 1 noisy, step 2 noisy and shifted, one point lost in it."""
    x, y = np.meshgrid(np.arange(float(SIDE)), np.arange(float(SIDE)), indexing="ij")
    reference = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    n = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = n[:-1, :-1].ravel(), n[1:, :-1].ravel(), n[1:, 1:].ravel(), n[:-1, 1:].ravel()
    rng = np.random.default_rng(4)
    vertices = np.stack([reference, *(reference + rng.normal(0.0, SIGMA, reference.shape) for _ in range(2))])
    vertices[2] += SHIFT
    vertices[2, 5] = np.nan
    F, N = 3, len(reference)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    matches = Matches(("1", "2"), np.zeros((N, 2)), rng.normal(size=(F, 2, N, 2)), rng.uniform(size=(F, N)),
                      rng.uniform(size=(F, 2, N, 2)), np.zeros((F, N), np.int8), np.arange(N))  # fmt: skip
    return Results(
        rig="sheet", steps=("reference", "still", "shifted"), cameras=(), pairs=(("1", "2"),), vertices_ref=reference,
        vertices=vertices, faces=faces, pair=np.zeros(len(faces), np.int64), vertex_pair=np.zeros(N, np.int64),
        correlation=rng.uniform(size=(F, N)), sigma_xyz=rng.uniform(size=(F, N, 3)), status=np.zeros((F, N), np.int8),
        matches=(matches,), chi2=rng.uniform(size=(F, N)), sigma_lambda=rng.uniform(size=(F, len(faces), 2)),
    )  # fmt: skip


def test_the_noise_that_was_put_in_is_what_is_found() -> None:
    floor = noise_floor([select_steps(sheet_at_rest(), [0, 1])])
    found = floor["quantities"]
    count = SIDE * SIDE
    for axis in "xyz":
        assert found[f"displacement_{axis}"]["std"] == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * count))
        assert abs(found[f"displacement_{axis}"]["mean"]) < 4 * SIGMA / np.sqrt(count)
    assert found["displacement"]["rms"] == pytest.approx(np.sqrt(3) * SIGMA, rel=0.05)
    # In a right triangle with legs of 1 mm each normal strain scatters by √2 σ, the shear strain by σ.
    wanted = SIGMA * np.sqrt(2.0 + 2.0 + 2.0 * 1.0)
    rms = np.hypot(found["E_magnitude"]["mean"], found["E_magnitude"]["std"])
    assert rms == pytest.approx(wanted, rel=0.15)
    assert floor["captures"] == 1


def test_a_common_motion_counts_as_moved_and_not_as_noise_of_the_shape() -> None:
    floor = noise_floor([select_steps(sheet_at_rest(), [0, k]) for k in (1, 2)])
    assert floor["moved_mm"] == pytest.approx(np.linalg.norm(SHIFT), rel=0.01)
    assert floor["quantities"]["displacement_x"]["rms"] > SHIFT[0] / 2
    assert floor["quantities"]["displacement_rest"]["rms"] == pytest.approx(np.sqrt(3) * SIGMA, rel=0.05)
