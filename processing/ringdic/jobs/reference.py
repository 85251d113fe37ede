"""Matching of the reference images: where the cameras stood, and which of them agree with one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Vectors
from ringdic.calibration.calibrated_rig import CalibratedRig
from ringdic.calibration.motion_findings import left_out_finding
from ringdic.charts.tasks import ChartsJob, charts_job
from ringdic.findings import Finding
from ringdic.geometry.camera import Camera
from ringdic.jobs.task_runs import run_tasks
from ringdic.progress import Stages
from ringdic.session.folder import Capture, Session
from ringdic.settings import Settings
from ringdic.tasks import Executor, work_folder

#: Times that the reference is matched where cameras moved so far, in px of the image, that matches were lost by it.
_MOST_LOOKS, _LOOK_AGAIN_PX = 3, 0.3
_ABOUT_MM = 50.0  # about the middle of the rig, of points that the shift of images is told by


@dataclass(frozen=True)
class MatchedReference:
    """Reference images that are matched.

    job : the tasks, those of later steps included. calibrated, placed : the cameras, as they were calibrated and as
    they stood at the reference. findings : on a camera that was left out.
    """

    job: ChartsJob
    calibrated: tuple[Camera, ...]
    placed: tuple[Camera, ...]
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class ReferenceMatching:
    """A session whose reference images are to be matched.

    rig : the calibrated cameras. pairs : ids of neighbouring cameras that are used. steps : the captures, the reference
    first.
    """

    session: Session
    rig: CalibratedRig
    pairs: tuple[tuple[str, str], ...]
    steps: tuple[Capture, ...]
    settings: Settings

    def pairs_of(self, cameras: Sequence[Camera]) -> tuple[tuple[str, str], ...]:
        """The pairs of ids both of whose cameras are among some."""
        ids = {camera.id for camera in cameras}
        return tuple(pair for pair in self.pairs if ids.issuperset(pair))

    def agreeing(self, cameras: Sequence[Camera], stages: Stages, executor: Executor) -> MatchedReference:
        """Match the reference images of some cameras, without the one that contradicts all others, if there is one.

        That is a camera whose image shows another instant: no motion of it explains its matches, and without it the
        others agree. Its later images are of no use either, as they are tracked from the reference.
        """
        matched = self.matched(cameras, stages, executor)
        motions = matched.job.motions
        if motions.contradicting < 0:
            return matched
        others = [camera for c, camera in enumerate(cameras) if c != motions.contradicting]
        again = self.matched(others, stages, executor)
        finding = left_out_finding(motions, self.steps[0].id)
        return MatchedReference(again.job, again.calibrated, again.placed, (finding,))

    def matched(self, cameras: Sequence[Camera], stages: Stages, executor: Executor) -> MatchedReference:
        """Match the reference images of some cameras, again where these have moved so far that matches were lost."""
        bundle = self.rig.bundle
        covariance = None if bundle is None else bundle.pose_covariance([camera.id for camera in cameras])
        placed, work = tuple(cameras), work_folder(self.session.path)

        def job_with(assumed: Sequence[Camera], placed: Sequence[Camera]) -> ChartsJob:
            pairs = self.pairs_of(cameras)
            return charts_job(self.session, cameras, pairs, self.steps, self.settings, covariance, assumed, placed)

        for _ in range(_MOST_LOOKS):
            assumed = placed
            job = job_with(assumed, placed)
            run_tasks(job.at_reference, job.tasks, work, stages, executor)
            placed = job.motions.moved_cameras
            if _image_shift(assumed, placed, job.views.space.centre) < _LOOK_AGAIN_PX:
                break
        return MatchedReference(job_with(assumed, placed), tuple(cameras), placed)


def _image_shift(before: Sequence[Camera], after: Sequence[Camera], centre: Vectors) -> float:
    """Greatest distance, px, by which points about a centre (3,) mm move in the images with the cameras."""
    xyz = centre + _ABOUT_MM * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    shifts = [new.project(xyz) - old.project(xyz) for old, new in zip(before, after, strict=True)]
    return float(np.linalg.norm(shifts, axis=2).max())
