"""Steps taken out of results, and the cache of values on disk."""

from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from ringdic.results.fields import OPTIONAL_ARRAYS
from ringdic.results.results import Matches, Results
from ringdic.results.series import StepCache, select_steps

F, N = 4, 6


def some_results() -> Results:
    """A strip of triangles whose every number tells its place, and a step in which a point is lost."""
    rng = np.random.default_rng(3)
    reference = np.column_stack([np.arange(N) // 2, np.arange(N) % 2, np.zeros(N)]).astype(float)
    vertices = reference + rng.normal(0.0, 0.01, (F, N, 3)) * np.arange(F)[:, None, None]
    vertices[2, 3] = np.nan
    faces = np.array([[0, 2, 1], [2, 3, 1], [2, 4, 3], [4, 5, 3]])
    matches = Matches(("1",), rng.uniform(size=(N, 2)), rng.uniform(size=(F, 1, N, 2)), rng.uniform(size=(F, N)),
                      rng.uniform(size=(F, 1, N, 2)), np.zeros((F, N), np.int8), np.arange(N))  # fmt: skip
    ends = {"point": (N,), "vector": (N, 3), "face": (len(faces), 2)}
    known = {name: rng.uniform(size=(F, *ends[kind])) for name, kind in OPTIONAL_ARRAYS.items() if name != "chi2"}
    return Results(
        rig="strip", steps=tuple("abcd"), cameras=(), pairs=(), vertices_ref=reference, vertices=vertices, faces=faces,
        pair=np.zeros(len(faces), np.int64), vertex_pair=np.zeros(N, np.int64), correlation=rng.uniform(size=(F, N)),
        sigma_xyz=rng.uniform(size=(F, N, 3)), status=rng.integers(0, 9, (F, N)).astype(np.int8), matches=(matches,),
        **known,
    )  # fmt: skip


def same(first: Results, second: Results) -> None:
    assert first.steps == second.steps
    for name in ("vertices", "correlation", "sigma_xyz", "status", *OPTIONAL_ARRAYS):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for name in ("xy", "px", "c_ls", "sigma", "status", "vertex"):
        np.testing.assert_array_equal(getattr(first.matches[0], name), getattr(second.matches[0], name), err_msg=name)


def test_a_part_of_the_steps_keeps_everything_that_belongs_to_them() -> None:
    whole = some_results()
    part = select_steps(whole, [0, 2])
    assert part.steps == ("a", "c")
    for name in ("vertices", "correlation", "sigma_xyz", "status", "sigma_displacement", "sigma_lambda"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[[0, 2]])
    np.testing.assert_array_equal(part.matches[0].px, whole.matches[0].px[[0, 2]])
    assert part.chi2 is None
    with pytest.raises(ValueError, match="step 0"):
        select_steps(whole, [1, 2])


def test_cached_values_come_back_whichever_thread_asks(tmp_path: Path) -> None:
    cache, back = StepCache(tmp_path / "new"), {}

    def use(key: int) -> None:
        for step in range(20):
            cache.put((key, step), np.full(5000, 100 * key + step))
        for step in reversed(range(20)):
            back[key, step] = cache.get((key, step))

    threads = [Thread(target=use, args=(key,)) for key in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for (key, step), values in back.items():
        np.testing.assert_array_equal(values, np.full(5000, 100 * key + step))
    with pytest.raises(KeyError):
        cache.get("nothing")
