"""A rendered measurement is a folder of images that the import takes, with one image for every scene."""

from pathlib import Path

import pytest
from ringdic import import_folder
from ringdic_node.virtual_rig.__main__ import main


def test_the_folder_becomes_a_session(tmp_path: Path) -> None:
    wanted = ["--cameras", "2", "--scale", "0.05", "--boards", "3", "--steps", "1", "--at-rest", "1"]
    assert main([str(tmp_path / "images"), *wanted]) == 0
    session = tmp_path / "session"
    import_folder(tmp_path / "images", session)
    kinds = sorted(path.name.partition("-")[2] for path in (session / "captures").iterdir())
    assert kinds == ["board"] * 3 + ["specimen"] * 2 + ["static", "target"]
    assert (tmp_path / "images" / "cameras_truth.json").is_file()
    at_rest = [(tmp_path / "images" / kind / "cam_01" / "00.pgm").read_bytes() for kind in ("specimen", "static")]
    assert at_rest[0] != at_rest[1], "the noise of two images must differ"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--cameras", "1"], "--cameras must lie between 2 and the 12 of the ring, not 1"),
        (["--boards", "2"], "--boards must be at least 3, not 2"),
        (["--scale", "3"], "the scale must lie between 0.05 and 1, not 3.0"),
    ],
)
def test_what_cannot_be_rendered_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main([str(tmp_path / "images"), *arguments]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "images").exists()


def test_a_folder_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "--scale", "0.05"]) == 2
    assert "exists already" in capsys.readouterr().err
