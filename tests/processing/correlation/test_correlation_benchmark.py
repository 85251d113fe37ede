"""The benchmark's result: what it holds, and how two of them compare. No test here looks at a time."""

import json

import pytest

from processing.correlation import bench
from processing.errors import InputError


@pytest.fixture
def result(monkeypatch):
    small = bench.synthetic_pair(400, 600)
    monkeypatch.setattr(bench, "synthetic_pair", lambda: small)
    return {"correlation": bench.bench_correlation(step=20, repeats=1)}


def test_every_setting_is_run_and_every_point_matched(result):
    runs = result["correlation"]["runs"]
    assert {(run["radius"], run["order"]) for run in runs} == {(16, 1), (20, 1), (16, 2), (20, 2)}
    assert all(run["matched"] == 1.0 and run["iterations"] > 1 for run in runs)
    assert json.loads(json.dumps(result)) == result
    doubled = json.loads(json.dumps(result))
    for run in doubled["correlation"]["runs"]:
        run["kernel_points_per_second"] *= 2
    assert {row["kernel"] for row in bench.ratios(doubled, result)} == {2.0}
    assert {row["kernel"] for row in bench.ratios(result, result)} == {1.0}


def test_results_that_cannot_be_compared_are_refused(tmp_path):
    file = tmp_path / "earlier.json"
    with pytest.raises(InputError, match=r"earlier\.json: cannot be read"):
        bench.read_result(file)
    file.write_text("[1")
    with pytest.raises(InputError, match="not a JSON file"):
        bench.read_result(file)
    file.write_text("{}")
    with pytest.raises(InputError, match="not a result of the benchmark"):
        bench.read_result(file)
    with pytest.raises(InputError, match="no run in common"):
        bench.ratios({"correlation": {"runs": []}}, {"correlation": {"runs": []}})
