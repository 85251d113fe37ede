"""A small gallery goes from images to tables, and what cannot be measured is a row with its sentence."""

import json
from pathlib import Path

import pytest
from ringdic.errors import ComputationError
from ringdic_controller.studies import row_study
from ringdic_controller.studies.gallery import rows, run
from ringdic_controller.studies.gallery.run import run_gallery
from ringdic_controller.studies.row_study import scaled_settings


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the rendered images of one row."""
    folder = tmp_path_factory.mktemp("gallery")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "BOARDS", 4)
        about = run_gallery(folder, scale=0.15, only=["limb-arc2"], images_only=True)
    assert about["rows"] == ["limb-arc2"]
    assert len(list((folder / "images").glob("*.png"))) == 2 * (4 + 1 + 2)
    assert not (folder / "gallery.json").exists()
    return folder


def test_a_row_is_measured_and_compared_with_the_truth(images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "BOARDS", 4)
    totals = run_gallery(images, scale=0.15, only=["limb-arc2"])
    (entry,) = totals["entries"]
    assert entry["name"] == "limb-arc2"
    assert entry["refusal"] == ""
    assert entry["figures"]["wrong"] == 0
    assert entry["figures"]["covered"] > 0.5
    assert entry["figures"]["shape_mm"] < 0.25  # a pixel is 0.8 mm, and the two cameras stand 30° apart
    assert (images / entry["picture"]).is_file()
    assert json.loads((images / "gallery.json").read_text(encoding="utf-8")) == totals
    assert "| limb-arc2 |" in (images / "gallery.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (ComputationError("no camera pair gave a surface"), "no camera pair gave a surface"),
        (ValueError("of length 0"), "a fault of the program: ValueError: of length 0"),
    ],
)
def test_what_is_refused_or_fails_is_a_row_with_its_sentence(
    images: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, sentence: str
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(rows, "BOARDS", 4)
    monkeypatch.setattr(run, "calibrate_rig", lambda *_: None)
    monkeypatch.setattr(row_study, "process_session", refuse)
    totals = run_gallery(images, scale=0.15, only=["limb-arc2"])
    assert totals["reached"] == 0
    assert totals["entries"][0]["figures"] is None
    assert totals["entries"][0]["refusal"] == sentence
    assert totals["entries"][0]["missed"] == ["measured"]


def test_the_settings_are_the_defaults_at_the_scale_of_the_images() -> None:
    assert (scaled_settings(0.3).correlation.radius_px, scaled_settings(0.3).correlation.step_px) == (10, 5)
    assert scaled_settings(0.3).surface == scaled_settings(1.0).surface
