"""A small session of the virtual ring for the tests of whole runs."""

import shutil
from pathlib import Path

import cv2
import pytest
from ringdic.calibration.calibrated_rig import calibrate_rig
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
