"""The simulated camera delivers what the renderer shows of the commanded scene."""

from __future__ import annotations

import numpy as np
import pytest
from ringdic_node.cameras.camera import CameraError, Shot
from ringdic_node.cameras.virtual import VirtualNodeCamera
from ringdic_node.clock import SystemClock

pytest.importorskip("numba", reason="the simulated rig needs the extra 'virtual'")


def camera(name: str = "cam_02", **settings) -> VirtualNodeCamera:
    return VirtualNodeCamera(name, SystemClock(), **{"scale": 0.05, "seed": 3, **settings})


def test_the_commanded_scene_is_rendered_for_this_camera():
    from ringdic_node.virtual_rig.render import radiance
    from ringdic_node.virtual_rig.rig import paper_rig
    from ringdic_node.virtual_rig.scenes import scene
    from ringdic_node.virtual_rig.sensor import expose

    seen = camera()
    lens = paper_rig(cameras=12, scale=0.05, seed=3).cameras[1]
    for kind, index in (("board", 1), ("target", 0), ("specimen", 2)):
        frame = seen.capture(Shot(0, kind, index))
        assert frame.pixels.shape == (lens.height, lens.width)
        # The same light with another noise: the difference is that of two noises, a few grey levels.
        other = expose(radiance(lens, scene(kind, index, specimen="limb", seed=3)), 999)
        difference = frame.pixels.astype(float) - other
        assert 0.1 < difference.std() < 6.0
        assert abs(difference.mean()) < 0.2


def test_a_capture_can_be_repeated_exactly_and_its_noise_is_its_own():
    first = camera().capture(Shot(0, "specimen", 1)).pixels
    assert (camera().capture(Shot(0, "specimen", 1)).pixels == first).all()
    assert (camera(seed=4).capture(Shot(0, "specimen", 1)).pixels != first).any()
    assert (camera().capture(Shot(0, "specimen", 0)).pixels != first).any()


def test_frame_times_scatter_about_a_delay_of_the_camera():
    still = camera(jitter_us=0.0, offset_us=500.0)
    times = [still.capture(Shot(1_000, "target", 0)).time_ns for _ in range(3)]
    assert len(set(times)) == 1
    assert times[0] != 1_000
    other = camera("cam_03", jitter_us=0.0, offset_us=500.0).capture(Shot(1_000, "target", 0))
    assert other.time_ns != times[0]


def test_the_exposure_of_the_lock_is_recorded():
    locked = camera()
    assert locked.lock({"exposure_us": 1234}).metadata["ExposureTime"] == 1234.0
    assert locked.capture(Shot(0, "target", 0)).exposure_us == 1234.0


@pytest.mark.parametrize(
    ("settings", "told"),
    [({"scale": 7.0}, "scale"), ({"specimen": "brick"}, "brick"), ({"cameras": 1}, "cameras")],
)
def test_an_impossible_rig_is_told(settings, told):
    with pytest.raises(CameraError, match=told):
        camera(**settings)


def test_a_camera_that_the_ring_lacks_is_named():
    with pytest.raises(CameraError, match="cam_99"):
        camera("cam_99")


def test_pixels_are_a_plane_of_bytes():
    assert camera().capture(Shot(0, "board", 0)).pixels.dtype == np.uint8
