"""One step at once: the same positions as the whole run's, which then has that much less to do."""

import json
from pathlib import Path

import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.jobs import live_step
from ringdic.jobs.live_step import process_step
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress
from ringdic.results.reader import read_field, read_results
from ringdic.session.folder import live_results
from ringdic.session.load import LoadChannel
from ringdic.session.writer import Archive
from ringdic.settings import load_settings
from ringdic.tasks import LocalExecutor, OnTaskEnd, Task, TaskReport

SETTINGS = load_settings(None, ["correlation.radius_px=12", "correlation.step_px=8"])


class Counted:
    """A local executor that tells which tasks were made."""

    def __init__(self) -> None:
        self.made: list[str] = []

    def run(self, tasks: list[Task], on_end: OnTaskEnd) -> None:
        def tell(task: Task, report: TaskReport, count: int, total: int) -> None:
            if report.computed:
                self.made.append(task.name)
            on_end(task, report, count, total)

        LocalExecutor(1).run(tasks, tell)


def test_the_reference_and_each_step_are_made_once_and_the_whole_run_uses_them(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted()
    reference, middle, last = (f"000{k}-specimen" for k in (6, 7, 8))
    shape = read_results(process_step(session, reference, SETTINGS, executor=counted) / "results.h5")
    maps, charts = ([f"{what} {id_}" for id_ in ("cam_01", "cam_02")] for what in ("depth of camera", "chart of"))
    assert counted.made == [*maps, *charts, "poses of the cameras", "surface"]
    assert shape.steps == (reference,)
    archived = Archive(session.parent).open(session.name)
    archived.capture("0001-board").annotate("a note changes nothing that is computed")
    archived.capture(last).store_load(LoadChannel("force", "N", 12.5))
    with monkeypatch.context() as without:
        without.delattr(live_step, "calibrate_rig")
        live = process_step(session, last, SETTINGS, executor=counted)
    assert counted.made[6:] == [f"camera {id_}, {last}" for id_ in ("cam_01", "cam_02")]
    found = read_results(live / "results.h5")
    assert found.steps == (reference, last)
    assert found.matches == ()
    np.testing.assert_array_equal(found.faces, shape.faces)

    run = read_results(process_session(session, SETTINGS, executor=counted) / "results.h5")
    assert counted.made[8:] == [f"camera {id_}, {middle}" for id_ in ("cam_01", "cam_02")]
    known = [{"name": "force", "unit": "N", "values": [None, None, 12.5]}]
    assert json.loads((session / "results" / "0001" / "summary.json").read_text())["load"] == known
    by_place = {tuple(place): k for k, place in enumerate(run.vertices_ref)}
    same = [(k, by_place[tuple(place)]) for k, place in enumerate(found.vertices_ref) if tuple(place) in by_place]
    assert len(same) > 0.98 * len(run.vertices_ref)
    mine, theirs = np.transpose(same)
    np.testing.assert_array_equal(found.vertices[1, mine], run.vertices[2, theirs])
    stretch, _ = read_field(live / "results.h5", "lambda2", 1)
    expected, _ = read_field(session / "results" / "0001" / "results.h5", "lambda2", 2)
    assert np.nanmedian(stretch) == pytest.approx(np.nanmedian(expected), abs=1e-4)


def test_newer_steps_take_the_place_of_older_ones_and_of_themselves(session: Path) -> None:
    told: list[Progress] = []
    for step in ("0006-specimen", "0007-specimen", "0007-specimen", "0008-specimen"):
        process_step(session, step, SETTINGS, told.append)
    assert [folder.name for folder in live_results(session)] == ["0006-specimen", "0007-specimen", "0008-specimen"]
    assert not [path for path in (session / "live").iterdir() if path.name.startswith(".")]
    assert not (session / "results").exists()
    done = [progress.done for progress in told]
    assert {progress.stage for progress in told} >= {"calibrate", "correlate", "triangulate", "deform"}
    assert max(done) == pytest.approx(1.0)


@pytest.mark.parametrize("step", ["0005-target", "0099-specimen"])
def test_what_is_no_step_of_the_specimen_is_refused_by_its_name(session: Path, step: str) -> None:
    with pytest.raises(InputError, match=step):
        process_step(session, step, SETTINGS)
