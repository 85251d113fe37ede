"""Two cameras of the virtual ring, matched as tasks: what is made again, and that it makes no difference."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration.calibrated_rig import calibrate_rig
from ringdic.charts.tasks import ChartsJob, charts_job
from ringdic.correlation import Status
from ringdic.geometry.camera import Camera
from ringdic.jobs.pipeline import process_session
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import open_session
from ringdic.settings import Settings, load_settings
from ringdic.tasks import LocalExecutor, OnTaskEnd, Task, TaskReport, process_memory

SCALE, STEPS = 0.2, 3  # of the session
LATER = 2 * (STEPS - 1)  # images after the reference
SMALL = ["correlation.radius_px=12", "correlation.step_px=8"]
SETTINGS = load_settings(None, SMALL)
PAPER = load_settings(None, [*SMALL, "method=paper"])


class Counted:
    """A local executor that tells which tasks were made, and stops after so many."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.made: list[str] = []
        self.stop_after = stop_after

    def run(self, tasks: list[Task], on_end: OnTaskEnd) -> None:
        def tell(task: Task, report: TaskReport, count: int, total: int) -> None:
            if report.computed:
                self.made.append(task.name)
            if self.stop_after == len(self.made):
                raise KeyboardInterrupt
            on_end(task, report, count, total)

        LocalExecutor(1).run(tasks, tell)


def job_of(session: Path, settings: Settings = SETTINGS, steps: slice = slice(None), **changed: Camera) -> ChartsJob:
    """The tasks of a session, with other cameras where they are given."""
    read = open_session(session)
    ring = calibrate_rig(read, settings.calibration)
    cameras = [changed.get(id_, each.camera) for id_, each in ring.cameras.items()]
    return charts_job(read, cameras, read.rig.pairs, read.of_kind("specimen")[steps], settings)


def keys(session: Path, settings: Settings = SETTINGS, steps: slice = slice(None), **changed: Camera) -> list[str]:
    return [task.key for task in job_of(session, settings, steps, **changed).tasks]


def same(first: Results, second: Results) -> None:
    """Bit for bit."""
    for name in ("vertices", "faces", "correlation", "sigma_xyz", "status"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for one, other in zip(first.matches, second.matches, strict=True):
        np.testing.assert_array_equal(one.px, other.px)
        np.testing.assert_array_equal(one.sigma, other.sigma)


@pytest.mark.parametrize(("settings", "count"), [(SETTINGS, 6 + LATER), (PAPER, 4 + LATER)], ids=["best", "paper"])
def test_an_interrupted_job_makes_only_what_is_missing_and_the_same_results(
    session: Path, settings: Settings, count: int
) -> None:
    # A depth map and a chart of each camera, the check of their poses, or one chart of the pair; then the surface, and
    # each step of each camera.
    interrupted, resumed, whole = Counted(stop_after=2), Counted(), Counted()
    with pytest.raises(KeyboardInterrupt):
        process_session(session, settings, executor=interrupted)
    assert not (session / "results").exists()
    process_memory.clear()
    second = read_results(process_session(session, settings, executor=resumed) / "results.h5")
    assert len(interrupted.made) == 2
    assert sorted([*interrupted.made, *resumed.made]) == sorted({*interrupted.made, *resumed.made})
    assert len(interrupted.made) + len(resumed.made) == count
    shutil.rmtree(session / "work")
    fresh = read_results(process_session(session, settings, executor=whole) / "results.h5")
    assert len(whole.made) == count
    same(second, fresh)
    again = Counted()
    same(read_results(process_session(session, settings, executor=again) / "results.h5"), fresh)
    assert again.made == []


def test_a_camera_without_an_image_at_a_step_loses_that_step_alone(session: Path) -> None:
    last = open_session(session).of_kind("specimen")[-1]
    record = last.images["cam_02"].with_name("capture.json")
    told = json.loads(record.read_text(encoding="utf-8"))
    told["cameras"]["cam_02"].pop("file")
    record.write_text(json.dumps(told), encoding="utf-8")
    results = read_results(process_session(session, SETTINGS) / "results.h5")
    assert (results.status[:2] == 0).mean() > 0.95
    assert (results.status[2] != Status.GOOD).all()
    assert (results.status[2] == Status.NOT_REACHED).mean() > 0.95
    assert [task is None for task in job_of(session).steps[1]] == [False, True]


def test_threads_side_by_side_make_the_same(session: Path) -> None:
    alone = read_results(process_session(session, SETTINGS, executor=LocalExecutor(1)) / "results.h5")
    shutil.rmtree(session / "work")
    same(read_results(process_session(session, SETTINGS, executor=LocalExecutor(2)) / "results.h5"), alone)


def test_one_more_capture_leaves_the_earlier_steps(session: Path) -> None:
    before, after = keys(session, steps=slice(0, 2)), keys(session)
    assert set(before) < set(after)
    newest = keys(session, steps=slice(0, None, 2))  # the reference and the newest step
    assert set(newest) < set(after)


def _image(session: Path) -> None:
    path = next(iter(sorted(open_session(session).of_kind("specimen")[1].images.values())))
    path.write_bytes(path.read_bytes() + b" ")  # the record's size no longer agrees


def _mask(session: Path) -> None:
    (session / "mask").mkdir()
    first = open_session(session).rig.pairs[0][0]
    mask = np.full((round(3280 * SCALE), round(2464 * SCALE)), 255, np.uint8)
    assert cv2.imwrite(str(session / "mask" / f"{first}.png"), mask)


@pytest.mark.parametrize(("change", "count"), [(_image, 1), (_mask, 6 + LATER)])
def test_another_image_or_mask_is_matched_anew(session: Path, change: Callable[[Path], None], count: int) -> None:
    before = keys(session)
    change(session)
    assert sum(one != other for one, other in zip(before, keys(session), strict=True)) == count


@pytest.mark.parametrize(
    ("setting", "anew"),
    [
        ("correlation.radius_px=13", True),
        ("correlation.tolerance=1e-4", True),
        ("strain.window_mm=5", False),
        ("surface.merge=none", False),
        ("surface.sigma_max_px=0.1", False),
    ],
)
def test_settings_that_matches_rest_on_make_them_anew(session: Path, setting: str, anew: bool) -> None:
    told = [*SMALL, setting]
    assert (set(keys(session)).isdisjoint(keys(session, load_settings(None, told)))) is anew


def test_how_the_charts_are_joined_leaves_their_matches(session: Path) -> None:
    before, after = job_of(session), job_of(session, load_settings(None, [*SMALL, "surface.merge=none"]))
    assert [task.key for task in before.charts] == [task.key for task in after.charts]
    assert before.surface.key != after.surface.key


def test_another_calibration_makes_all_anew(session: Path) -> None:
    camera = job_of(session).views.cameras[1]
    P = camera.P.copy()
    P[0, 3] += 1e-9
    moved = Camera(camera.id, P, camera.size, camera.intrinsics)
    assert set(keys(session)).isdisjoint(keys(session, **{camera.id: moved}))


def test_no_image_is_decoded_and_no_map_or_surface_read_twice(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[int] = []
    decode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: decoded.append(len(data)) or decode(data, flags))
    before = process_memory.computations
    process_session(session, SETTINGS, executor=LocalExecutor(2))
    assert len(decoded) == 2 * STEPS
    images, references, depth_maps, surfaces = 2, 2, 2, 1  # later images serve one task each and are not kept
    assert process_memory.computations - before == images + references + depth_maps + surfaces
