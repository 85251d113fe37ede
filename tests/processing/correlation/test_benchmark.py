"""The benchmark's figures are of the pair it names, and two results are compared run by run."""

import json

import pytest
from ringdic.correlation import bench
from ringdic.errors import InputError


@pytest.fixture
def result(monkeypatch: pytest.MonkeyPatch) -> dict:
    small = bench.synthetic_pair(240, 400)
    monkeypatch.setattr(bench, "synthetic_pair", lambda: small)
    return {"correlation": bench.bench_correlation(repeats=1, step=20)}


def test_every_run_matches_the_pair_and_counts_its_time(result: dict) -> None:
    runs = result["correlation"]["runs"]
    assert {(run["radius"], run["order"]) for run in runs} == {(16, 1), (20, 1), (16, 2), (20, 2)}
    for run in runs:
        assert run["matched"] == 1.0
        seconds = run["seconds"]
        assert 0 < seconds["prepare"] + seconds["start"] + seconds["refine"] <= 1.5 * seconds["whole"]
        assert 1 <= run["iterations"] < 10


def test_a_result_compared_with_itself_is_as_fast(result: dict, tmp_path) -> None:
    earlier = tmp_path / "before.json"
    earlier.write_text(json.dumps(result))
    for row in bench.ratios(result, bench.read_result(earlier)):
        assert row["kernel"] == row["refine"] == row["whole"] == 1.0


def test_half_the_time_is_twice_as_fast(result: dict) -> None:
    faster = json.loads(json.dumps(result))
    for run in faster["correlation"]["runs"]:
        run["kernel_points_per_second"] *= 2
        run["seconds"]["whole"] /= 2
    assert all(row["kernel"] == row["whole"] == 2.0 for row in bench.ratios(faster, result))


def test_a_file_without_a_result_is_refused(tmp_path) -> None:
    path = tmp_path / "x.json"
    path.write_text("[1]")
    with pytest.raises(InputError, match="not a result of the benchmark"):
        bench.read_result(path)
