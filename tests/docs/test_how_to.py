"""The code of the how-to pages runs on the tutorial's session and does what the pages say."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ringdic.results.evaluation import evaluate_results
from ringdic.session.images import read_gray


def python(page: Path) -> list[str]:
    """The blocks of Python of a page."""
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def block(page: Path, word: str) -> dict[str, Any]:
    """The names that the one block with a word in it defines."""
    found = [text for text in python(page) if word in text]
    names: dict[str, Any] = {}
    exec(found[0], names)
    return names


def test_a_field(tutorial: Any, pages: Path) -> None:
    entry = block(pages / "how_to/field.md", "stretch_ratio = Field(")["stretch_ratio"]
    step = evaluate_results(tutorial.results).step(2)
    ratio = step.scalar(entry)
    measured = np.isfinite(ratio)
    assert measured.any()
    assert (ratio[measured] >= 1.0).all()
    np.testing.assert_allclose(ratio[measured], (step.face["lambda2"] / step.face["lambda1"])[measured])


def test_an_export(tutorial: Any, pages: Path, tmp_path: Path) -> None:
    results = evaluate_results(tutorial.results)
    block(pages / "how_to/export.md", "def export_xyz")["export_xyz"](results, tmp_path)
    assert sorted(path.stem for path in tmp_path.iterdir()) == sorted(results.steps)
    for step, name in enumerate(results.steps):
        positions = results.positions(step)
        written = np.loadtxt(tmp_path / f"{name}.xyz")
        np.testing.assert_allclose(written, positions[np.isfinite(positions).all(axis=1)], atol=1e-4)


@pytest.fixture
def workplace(tutorial: Any, tmp_path: Path) -> Path:
    """A folder with what the page on scripts begins with: a processed session, a folder of sessions, two images."""
    shutil.copytree(tutorial.session, tmp_path / "session")
    (tmp_path / "sessions").mkdir()
    shutil.copytree(tutorial.session, tmp_path / "sessions" / "first")
    for name, step in (("reference", "00"), ("current", "01")):
        image = tutorial.folder / "images" / "specimen" / "cam_02" / f"{step}.pgm"
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), read_gray(image))
    return tmp_path


def test_a_script(workplace: Path, pages: Path) -> None:
    text = "import matplotlib\nmatplotlib.use('Agg')\n" + "\n".join(python(pages / "how_to/script.md"))
    done = subprocess.run([sys.executable, "-c", text], cwd=workplace, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "first" in done.stdout
    for name in ("results.npz", "points.npz"):
        assert (workplace / name).is_file(), name
