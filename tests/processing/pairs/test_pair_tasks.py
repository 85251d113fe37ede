"""Two cameras of the virtual ring, matched as tasks: what is made again, and that it makes no difference."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration.calibrated_rig import calibrate_rig
from ringdic.correlation import CorrelationSettings, Status
from ringdic.geometry.camera import Camera
from ringdic.jobs.pipeline import process_session
from ringdic.pairs.tasks import PairJob, ordered_tasks, pair_jobs
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import open_session
from ringdic.settings import Settings, load_settings
from ringdic.sweep.sweep import DepthSearch
from ringdic.tasks import LocalExecutor, OnTaskEnd, Task, TaskReport, process_memory

SCALE, STEPS = 0.2, 3  # of the session
SMALL = ["correlation.radius_px=12", "correlation.step_px=8"]
SETTINGS = load_settings(None, SMALL)
GLOBAL = load_settings(None, [*SMALL, "surface.method=global"])
CHARTS = load_settings(None, [*SMALL, "surface.method=charts"])


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


def jobs(session: Path, settings: Settings = SETTINGS, steps: slice = slice(None), **changed: Camera) -> list[PairJob]:
    """The tasks of a session, with other cameras where they are given."""
    read = open_session(session)
    ring = calibrate_rig(read, settings.calibration)
    cameras = {id_: changed.get(id_, each.camera) for id_, each in ring.cameras.items()}
    search = DepthSearch(radius=57.0, reach=settings.surface.reach_mm, incidence=settings.surface.incidence_deg)
    correlation = CorrelationSettings(**settings.correlation.keywords)
    return pair_jobs(read, cameras, read.rig.pairs, read.of_kind("specimen")[steps], search, correlation)


def keys(session: Path, settings: Settings = SETTINGS, steps: slice = slice(None), **changed: Camera) -> list[str]:
    return [task.key for task in ordered_tasks(jobs(session, settings, steps, **changed))]


def same(first: Results, second: Results) -> None:
    """Bit for bit."""
    for name in ("vertices", "faces", "correlation", "sigma_xyz", "status"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for one, other in zip(first.matches, second.matches, strict=True):
        np.testing.assert_array_equal(one.px, other.px)
        np.testing.assert_array_equal(one.sigma, other.sigma)


@pytest.mark.parametrize(
    ("settings", "count"),
    [(SETTINGS, 1 + 2 * (STEPS - 1)), (GLOBAL, 1 + 2), (CHARTS, 5 + 2 * (STEPS - 1))],
    ids=["pairs", "global", "charts"],
)
def test_an_interrupted_job_makes_only_what_is_missing_and_the_same_results(
    session: Path, settings: Settings, count: int
) -> None:
    # Pairs: the reference, and each step of each camera. All cameras together: the shape, and each camera's block of
    # steps. Charts: a depth map and a chart of each camera, the surface, and each step of each camera.
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


def test_what_the_reference_does_not_share_is_left_out(session: Path) -> None:
    process_session(session, SETTINGS, executor=LocalExecutor(1))
    for job in jobs(session):
        _, at_reference = job.at_reference()
        shared = at_reference.status == Status.GOOD
        assert 0.9 < shared.mean() < 1.0
        for k in range(1, STEPS):
            found = job.step(k, at_reference)
            np.testing.assert_array_equal(found.status[~shared], at_reference.status[~shared])
            known = np.isfinite(found.px).all(axis=2)
            assert not known[:, ~shared].any()
            np.testing.assert_array_equal(known.all(axis=0), found.status == Status.GOOD)
            assert (found.status[shared] == Status.GOOD).mean() > 0.95


def test_a_camera_without_an_image_at_a_step_loses_that_step_alone(session: Path) -> None:
    last = open_session(session).of_kind("specimen")[-1]
    record = last.images["cam_02"].with_name("capture.json")
    told = json.loads(record.read_text(encoding="utf-8"))
    told["cameras"]["cam_02"].pop("file")
    record.write_text(json.dumps(told), encoding="utf-8")
    results = read_results(process_session(session, SETTINGS) / "results.h5")
    assert (results.status[:2] == 0).mean() > 0.95
    assert (results.status[2] == Status.NOT_REACHED).all()
    (job,) = jobs(session)
    assert [task is None for task in job.camera_jobs[1].steps] == [False, True]


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


@pytest.mark.parametrize(("change", "count"), [(_image, 1), (_mask, 1 + 2 * (STEPS - 1))])
def test_another_image_or_mask_is_matched_anew(session: Path, change: Callable[[Path], None], count: int) -> None:
    before = keys(session)
    change(session)
    assert sum(one != other for one, other in zip(before, keys(session), strict=True)) == count


@pytest.mark.parametrize(
    ("setting", "anew"),
    [
        ("correlation.radius_px=13", True),
        ("correlation.tolerance=1e-4", True),
        ("surface.reach_mm=15", True),
        ("strain.window_mm=5", False),
        ("surface.merge=none", False),
        ("surface.sigma_max_px=0.1", False),
        ("tracking.two_pass=false", False),
    ],
)
def test_settings_that_matches_rest_on_make_them_anew(session: Path, setting: str, anew: bool) -> None:
    told = [*SMALL, setting]
    assert (set(keys(session)).isdisjoint(keys(session, load_settings(None, told)))) is anew


def test_another_calibration_makes_all_anew(session: Path) -> None:
    camera = jobs(session)[0].cameras[1]
    P = camera.P.copy()
    P[0, 3] += 1e-9
    moved = Camera(camera.id, P, camera.size, camera.intrinsics)
    assert set(keys(session)).isdisjoint(keys(session, **{camera.id: moved}))


def test_no_image_is_decoded_twice(session: Path) -> None:
    before = process_memory.computations
    process_session(session, SETTINGS, executor=LocalExecutor(2))
    images, references, later = 2 * STEPS, 2, 2 * (STEPS - 1)
    assert (
        process_memory.computations - before == images + references + later
    )  # the last: what each camera showed, asked for by its pairs
