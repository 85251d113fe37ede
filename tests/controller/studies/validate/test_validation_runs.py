"""Images are rendered once, sessions share them, and a small validation goes from images to tables."""

import json
from pathlib import Path

import numpy as np
import pytest
from ringdic import settings as presets
from ringdic.errors import InputError
from ringdic.session.folder import open_session
from ringdic.session.images import read_gray
from ringdic_controller.studies.validate import report
from ringdic_controller.studies.validate.experiments import Validation, figures
from ringdic_controller.studies.validate.figures import PAPER
from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot
from ringdic_controller.studies.validate.plots import draw
from ringdic_controller.studies.validate.run import run_validation, scaled
from ringdic_controller.studies.validate.scenery import Scenery
from ringdic_node.virtual_rig.render import radiance
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes import BoardScene, Cylinder, Specimen, TargetScene

SMALL = paper_rig(4, 0.06, seed=1)


def shots(kind: int = 0) -> dict[str, RenderedShot]:
    return {camera.id: RenderedShot(camera, BoardScene(kind), 3) for camera in SMALL.cameras}


def test_an_image_is_rendered_once_and_again_only_if_something_it_depends_on_changes(tmp_path: Path) -> None:
    cache = ImageCache(tmp_path / "images")
    wanted = list(shots().values())
    first = cache.render_missing(wanted)
    times = [path.stat().st_mtime_ns for path in first]
    assert cache.render_missing(wanted) == first
    assert [path.stat().st_mtime_ns for path in first] == times
    camera = SMALL.cameras[0]
    keys = {
        RenderedShot(camera, BoardScene(0), 3).key,
        RenderedShot(camera, BoardScene(0), 4).key,
        RenderedShot(camera, BoardScene(1), 3).key,
        RenderedShot(camera, TargetScene(), 3).key,
        RenderedShot(camera, TargetScene(print_error=0.03), 3).key,
        RenderedShot(camera, Specimen(Cylinder(), 0), 3).key,
        RenderedShot(camera, Specimen(Cylinder((0.2, 0, 0)), 0), 3).key,
        RenderedShot(camera, BoardScene(0), 3, jpeg=80).key,
        RenderedShot(SMALL.cameras[1], BoardScene(0), 3).key,
    }
    assert len(keys) == 9


def test_a_session_shares_its_images_with_the_cache(tmp_path: Path) -> None:
    cache = ImageCache(tmp_path / "images")
    cache.render_missing([*shots(0).values(), *shots(1).values()])
    path = make_session(tmp_path / "s", SMALL.rig_toml(), [("board", shots(0)), ("board", shots(1))], cache)
    session = open_session(path)
    assert [capture.kind for capture in session.captures] == ["board", "board"]
    for capture, wanted in zip(session.captures, (shots(0), shots(1)), strict=True):
        for id_, shot in wanted.items():
            assert capture.images[id_].stat().st_ino == cache.path(shot).stat().st_ino
            np.testing.assert_array_equal(read_gray(capture.images[id_]), read_gray(cache.path(shot)))
    made = (path / "session.json").stat().st_mtime_ns
    make_session(path, SMALL.rig_toml(), [], cache)
    assert (path / "session.json").stat().st_mtime_ns == made  # one that is there is kept


def test_every_image_has_noise_of_its_own() -> None:
    scenery = Scenery(scale=0.1, boards=2, cylinder=2, limb=2)
    seeds = [
        shot.seed
        for name in ("boards", "target", "moved", "printed", "cylinder", "limb", "spoilt")
        for scene in scenery.shots(name)
        for shot in scene.values()
    ]
    assert len(set(seeds)) == len(seeds) == 12 * (2 + 1 + 1 + 1 + 3 + 3 + 2)


def test_the_spoilt_limb_is_hidden_and_worn_in_part() -> None:
    scenery = Scenery(scale=0.1, boards=1, cylinder=1, limb=1)
    clean, spoilt = scenery.scenes("limb")[0], scenery.scenes("spoilt")[0]
    changed = [np.abs(radiance(c, spoilt) - radiance(c, clean)) > 0.1 for c in scenery.rig.cameras]
    assert all(each.any() for each in changed)
    assert 0.002 < np.mean(changed) < 0.2


def test_the_settings_of_full_scale_shrink_with_the_image_but_not_below_what_a_subset_needs() -> None:
    half, tenth = scaled(presets.PAPER, 0.5), scaled(presets.PAPER, 0.1)
    assert (half.correlation.radius_px, half.correlation.step_px) == (10, 5)
    assert (tenth.correlation.radius_px, tenth.correlation.step_px) == (10, 5)
    assert scaled(presets.Settings(), 1.0) == presets.Settings()


def test_an_unknown_experiment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no experiment 'table'"):
        run_validation(tmp_path, scale=0.25, only=["table"])


def test_a_small_calibration_is_validated_from_images_to_tables(tmp_path: Path) -> None:
    scale = 0.2
    ways = {PAPER: scaled(presets.PAPER, scale)}
    found = Validation(tmp_path, Scenery(scale, cameras=6, boards=4), ways).run(["calibration"])
    shown = figures(found)
    value = {figure.quantity: figure.values[PAPER] for figure in shown}
    # Centroids good to 0.05 px where a pixel is half a millimetre.
    assert value["control points, RMS"] < 0.03
    assert value["5 mm stage: superimposed RMS"] < 0.05
    assert abs(value["5 mm stage: length − 5"]) < 0.01
    plots = draw(tmp_path, found)
    about = {"cameras": 6, "size": [1, 1], "radius_px": 10, "step_px": 5, "seconds": {"all": 1.0}}
    written = report.write(tmp_path, shown, list(ways), about, plots)
    assert written["aimed_at"] == 0  # aims are of the better way
    assert json.loads((tmp_path / "validation.json").read_text(encoding="utf-8")) == written
    page = (tmp_path / "validation.md").read_text(encoding="utf-8")
    assert "| Table 2 | control points, RMS, mm | 0.047 |" in page
    assert all(path.is_file() and f"({path.name})" in page for path in plots.values())
