"""A small study goes from images to its table, and what is refused or fails is a row with its sentence."""

import json
from pathlib import Path

import pytest
from ringdic.errors import ComputationError
from ringdic_controller.studies import row_study
from ringdic_controller.studies.gallery import rows as gallery_rows
from ringdic_controller.studies.mishaps import run
from ringdic_controller.studies.mishaps.changes import rig_described
from ringdic_controller.studies.mishaps.rows import Expectation, MishapRow
from ringdic_controller.studies.mishaps.run import run_mishaps

CALM, BUMPED = "calm-arc2", "bumped-after-calibration-3px-turned-rows-arc2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the rendered images of two rows."""
    folder = tmp_path_factory.mktemp("mishaps")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gallery_rows, "BOARDS", 4)
        about = run_mishaps(folder, scale=0.15, only=[CALM, BUMPED], images_only=True)
    assert about["rows"] == [CALM, BUMPED]
    assert len(list((folder / "images").glob("*.png"))) == 2 * (4 + 1 + 3) + 3  # the bumped camera took three others
    return folder


def test_a_bumped_camera_makes_the_surface_wrong_and_the_table_shows_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gallery_rows, "BOARDS", 4)
    totals = run_mishaps(folder, scale=0.15, only=[CALM, BUMPED])
    calm, bumped = totals["entries"]
    assert [calm["name"], bumped["name"]] == [CALM, BUMPED]
    assert calm["run"]["errors"]["wrong"] == 0.0
    assert calm["run"]["errors"]["displacement_mm"] < 0.1  # a pixel is 0.8 mm
    # 3 px along the base of two cameras 30° apart, a pixel 0.8 mm: no word, or a surface millimetres off, or followed.
    said = bumped["judgement"]["outcome"]
    errors = bumped["run"]["errors"]
    assert errors is None or (errors["shape_mm"] > 1.0) == (said not in ("followed", "within σ"))
    assert sum(totals["outcomes"].values()) == totals["rows"] == 2
    assert json.loads((folder / "mishaps.json").read_text(encoding="utf-8")) == totals
    page = (folder / "mishaps.md").read_text(encoding="utf-8")
    assert f"| {BUMPED} | {said} |" in page


@pytest.mark.parametrize(
    ("error", "sentence", "outcome"),
    [
        (ComputationError("no camera pair gave a surface"), "no camera pair gave a surface", "FALSE ALARM"),
        (ValueError("of length 0"), "a fault of the program: ValueError: of length 0", "FAULT"),
    ],
)
def test_what_is_refused_or_fails_is_a_row_with_its_sentence(
    folder: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, sentence: str, outcome: str
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(gallery_rows, "BOARDS", 4)
    monkeypatch.setattr(row_study, "process_session", refuse)
    totals = run_mishaps(folder, scale=0.15, only=[CALM])
    assert totals["good"] == 0
    (entry,) = totals["entries"]
    assert entry["run"]["errors"] is None
    assert entry["run"]["refusal"] == sentence
    assert entry["judgement"]["outcome"] == outcome


def test_a_rig_file_that_is_refused_is_a_refusal(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def impossible() -> list[MishapRow]:
        values = {"column_spacing_mm": 15.0}
        return [MishapRow("target", "wide", "arc2", rig_described(values), Expectation(words=("columns",)))]

    monkeypatch.setattr(gallery_rows, "BOARDS", 4)
    monkeypatch.setattr(run, "all_rows", impossible)
    (entry,) = run_mishaps(folder, scale=0.15)["entries"]
    assert entry["judgement"]["outcome"] == "refused"
    assert "do not fit round the radius" in entry["run"]["refusal"]
