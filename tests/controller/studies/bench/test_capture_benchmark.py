"""The capture benchmark on a small rig: the same processes and the same code, few and small images."""

from __future__ import annotations

import pytest
from ringdic.errors import InputError
from ringdic_controller.studies.bench.capture import bench_capture, capture_ratios

SIZE = (400, 500)


def test_three_nodes_deliver_what_they_played_back():
    found = bench_capture((3,), rounds=2, size=SIZE)
    (run,) = found["runs"]
    header = len(b"P5\n400 500\n255\n")
    assert found["image_bytes"] == 400 * 500 + header
    assert (run["nodes"], run["rounds"], run["verified"]) == (3, 2, 6)
    assert run["bytes"] == 3 * found["image_bytes"]
    for name in ("archived_s", "acknowledged_s", "pressed_s"):
        assert 0 < run[name]["median"] <= run[name]["largest"], name
    # The press comes at least the trigger's lead before the moment.
    assert run["pressed_s"]["median"] > run["acknowledged_s"]["median"] + 0.3
    assert run["mb_per_second"] == pytest.approx(run["bytes"] / 1e6 / run["acknowledged_s"]["median"])
    assert run["controller_memory_mb"] is None or run["controller_memory_mb"] > 10


def test_ratios_tell_how_much_better_the_new_result_is():
    def result(seconds: float, **told: float) -> dict:
        times = {"median": seconds, "largest": seconds}
        run = {"nodes": 12, "bytes": 100, "archived_s": times, "acknowledged_s": times}
        return {"runs": [{**run, "controller_memory_mb": 200.0, **told}]}

    (row,) = capture_ratios(result(1.0, nodes_cpu_s=2.0), result(2.0, nodes_cpu_s=3.0, controller_cpu_s=1.0))
    assert row == {"nodes": 12, "archived": 2.0, "acknowledged": 2.0, "nodes_cpu": 1.5, "memory": 1.0}
    with pytest.raises(InputError, match="no capture run in common"):
        capture_ratios(result(1.0), {"runs": []})
