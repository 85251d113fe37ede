"""A small session of the virtual ring for the tests of whole runs."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.calibration.calibrated_rig import calibrate_rig
from ringdic.correlation import CorrelationSettings
from ringdic.geometry.camera import Camera
from ringdic.multiview.motion import Motion, surface_motion, vertex_track
from ringdic.multiview.shape import ReferenceShape
from ringdic.multiview.surface import reference_pixels
from ringdic.multiview.tracking import CameraTrack, Tracking, at_reference, track_block
from ringdic.session.folder import open_session
from ringdic.session.importing import import_images
from ringdic.settings import CalibrationGroup
from ringdic.tasks import process_memory
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import VirtualRig, paper_rig
from ringdic_node.virtual_rig.scenes import scene

SCALE, STEPS = 0.2, 3


@pytest.fixture(scope="session")
def two_cameras(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of two cameras and three captures of the specimen, calibrated. Not to be written to."""
    folder = tmp_path_factory.mktemp("rig")
    rig = VirtualRig(paper_rig(12, SCALE).cameras[:2])
    source = folder / "source"
    source.mkdir()
    (source / "rig.toml").write_text(rig.rig_toml(), encoding="utf-8")
    for camera in rig.cameras:
        shots = {f"board/{camera.id}/{pose}.png": ("board", pose) for pose in range(4)}
        shots |= {f"specimen/{camera.id}/{step}.png": ("specimen", step) for step in range(STEPS)}
        for name, (kind, number) in {**shots, f"target/{camera.id}.png": ("target", 0)}.items():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(source / name), render(camera, scene(kind, number), number))
    import_images(source, folder / "session")
    calibrate_rig(open_session(folder / "session"), CalibrationGroup())
    return folder / "session"


@pytest.fixture
def session(two_cameras: Path, tmp_path: Path) -> Path:
    """A copy to process."""
    process_memory.clear()
    shutil.copytree(two_cameras, tmp_path / "session", ignore=shutil.ignore_patterns("results", "work"))
    return tmp_path / "session"


@pytest.fixture(scope="session")
def track_camera() -> Callable[..., CameraTrack]:
    """Call it with a camera's images, the reference first, and points to track: their track through all the steps."""

    def track(
        images: Sequence[np.ndarray | None],
        x0: np.ndarray,
        settings: CorrelationSettings,
        options: Tracking | None = None,
    ) -> CameraTrack:
        block, _ = track_block(
            images[0], images.__getitem__, range(1, len(images)), x0, None, settings, options or Tracking()
        )
        return CameraTrack.joined([at_reference(x0, images[0].shape), block])

    return track


@pytest.fixture(scope="session")
def motion_of_shape(track_camera: Callable[..., CameraTrack]) -> Callable[..., Motion]:
    """Call it with cameras, a reference shape and images by camera id and step: the shape's motion."""

    def motion(
        cameras: Sequence[Camera],
        shape: ReferenceShape,
        image: Callable[[str, int], np.ndarray | None],
        steps: int,
        settings: CorrelationSettings,
        sigma_max: float,
    ) -> Motion:
        tracks = []
        for k, camera in enumerate(cameras):
            vertex, x0 = reference_pixels(camera, shape, k)
            if len(vertex):
                track = track_camera([image(camera.id, step) for step in range(steps)], x0, settings)
                tracks.append(vertex_track(k, x0, vertex, shape, track, settings.step, sigma_max))
        return surface_motion(cameras, shape, tracks, steps)

    return motion
