"""The benchmark of a whole job, small, through the command; and what an earlier result is worth."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from ringdic.errors import InputError
from ringdic_controller.studies.bench import job
from ringdic_controller.studies.bench.command import bench_command, compared
from ringdic_controller.studies.bench.job import job_ratios

SMALL = ["correlation.radius_px=12", "correlation.step_px=10"]


@pytest.fixture(autouse=True)
def few_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """One step is rendered, the others are it again; as few board views as a lens needs."""
    monkeypatch.setattr(job, "_RENDERED", 1)
    monkeypatch.setattr(job, "_BOARDS", 5)


def measured(folder: Path, capsys: pytest.CaptureFixture[str], **changed: Any) -> dict[str, Any]:
    arguments = {"job": True, "steps": "2,3", "scale": 0.2, "cameras": 6, "set_": SMALL, "out": folder, "as_json": True}
    bench_command(data=None, repeats=1, interpolation="cubic", capture=False, live=False, all_=False, compare=None,
          **{**arguments, **changed})  # fmt: skip
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_jobs_of_two_lengths_are_timed_by_stage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = measured(tmp_path, capsys)["job"]
    assert [run["steps"] for run in found["runs"]] == [2, 3]
    assert found["boards"] == 5
    assert found["calibration_seconds"] > 5 * max(run["seconds"]["calibrate"] for run in found["runs"])  # kept
    for run in found["runs"]:
        assert {"prepare", "calibrate", "correlate", "triangulate", "deform"} <= run["seconds"].keys()
        assert sum(run["seconds"].values()) <= run["wall"]
        assert run["faces"] > 30
        assert run["peak_mb"] is None or 50 < run["peak_mb"] < 4000
        assert run["checks"]["calibration"] == 0.0  # found with the calibration, and kept with it
        assert all(seconds > 0.0 for what, seconds in run["checks"].items() if what != "calibration")
        assert run["cpu"] is None or run["checks_share"] * run["cpu"] == pytest.approx(sum(run["checks"].values()))
    # From nothing matched: what is kept grows with the steps, and no run of the benchmark stays in the session.
    assert found["runs"][1]["kept_mb"] > 1.05 * found["runs"][0]["kept_mb"]
    assert not list(tmp_path.glob("sessions/*/results/*"))
    images = sorted(tmp_path.glob("images/*"))
    again = [path for path in images if re.search(r"-1\.pgm$", path.name)]
    assert len(again) == 6  # the third image of each camera is its second with other noise
    assert all(path.read_bytes() != path.with_name(path.name.replace("-1.pgm", ".pgm")).read_bytes() for path in again)


def test_ratios_are_of_the_same_job() -> None:
    run = {"steps": 5, "wall": 10.0, "cpu": 18.0}
    before = {"cameras": 12, "scale": 1.0, "settings": [], "runs": [run]}
    faster = {**before, "runs": [{"steps": 5, "wall": 5.0, "cpu": 12.0}]}
    assert job_ratios(faster, before) == [{"steps": 5, "wall": 2.0, "cpu": 1.5}]
    assert compared({"job": faster}, {"job": before}) == [{"part": "job", "steps": 5, "wall": 2.0, "cpu": 1.5}]
    for other in ({**before, "cameras": 6}, {**before, "scale": 0.5}, {**before, "runs": [{**run, "steps": 4}]}):
        with pytest.raises(InputError, match="no job of the same"):
            job_ratios(faster, other)
    with pytest.raises(InputError, match="no part in common"):
        compared({"job": before}, {"capture": {}})


def test_a_number_of_steps_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for steps, sentence in (("2,many", "whole numbers"), ("1", "2 steps or more")):
        with pytest.raises(InputError, match=sentence):
            measured(tmp_path, capsys, steps=steps)
