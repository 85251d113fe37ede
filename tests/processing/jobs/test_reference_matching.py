"""A camera whose reference image contradicts all others takes no part; where all agree, all do."""

from types import SimpleNamespace

import numpy as np
import pytest
from ringdic.calibration.moved_cameras import CameraMotions, still_cameras
from ringdic.geometry.camera import Camera
from ringdic.jobs.reference import MatchedReference, ReferenceMatching
from ringdic.progress import Stages, silent
from ringdic.settings import Settings
from ringdic.tasks import LocalExecutor

CAMERAS = [Camera(f"c{k}", np.eye(3, 4) + 0.1 * k, (640, 480)) for k in range(4)]
PAIRS = (("c0", "c1"), ("c1", "c2"), ("c2", "c3"))


class Matching(ReferenceMatching):
    """Reference images of which one, where it takes part, contradicts all others. id_ : of its camera."""

    id_ = ""

    def matched(self, cameras, stages, executor) -> MatchedReference:
        ids = [camera.id for camera in cameras]
        motions = still_cameras(cameras)
        if self.id_ in ids:
            values = {**vars(motions), "contradicting": ids.index(self.id_), "misfit": np.full(len(ids), 9.0)}
            motions = CameraMotions(**{**values, "before": np.full(len(ids), 2.5)})
        return MatchedReference(SimpleNamespace(motions=motions), tuple(cameras), tuple(cameras))


@pytest.mark.parametrize("bad", ["c0", "c2", ""])
def test_the_camera_that_contradicts_all_others_is_left_out_and_named(bad: str) -> None:
    matching = Matching(None, None, PAIRS, (SimpleNamespace(id="0001-specimen"),), Settings())
    object.__setattr__(matching, "id_", bad)
    found = matching.agreeing(CAMERAS, Stages({}, silent), LocalExecutor())
    assert [camera.id for camera in found.calibrated] == [camera.id for camera in CAMERAS if camera.id != bad]
    assert found.job.motions.contradicting == -1
    assert [(each.code, each.cameras, each.step) for each in found.findings] == (
        [("camera-contradicts", (bad,), "0001-specimen")] if bad else []
    )
    assert matching.pairs_of(found.calibrated) == tuple(pair for pair in PAIRS if bad not in pair)
