"""Links of the texts outside the site lead to files, and the pictures of the README are small."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md", "deploy/README.md"])
def test_links_lead_to_files(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if not target.startswith("http"):
            assert ((ROOT / name).parent / target).exists(), target


def test_pictures_of_the_readme_are_small() -> None:
    pictures = list((ROOT / "docs" / "images").glob("*.png"))
    assert {picture.name for picture in pictures} == {"result.png", "page.png"}
    for picture in pictures:
        assert picture.stat().st_size < 200_000, picture.name


def test_the_version_is_the_same_everywhere() -> None:
    import ringdic

    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {ringdic.__version__}\n" in citation
    assert f"\n## [{ringdic.__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert set(re.findall(r"ringdic-([\d.]+)-py3", (ROOT / "deploy/README.md").read_text(encoding="utf-8"))) == {
        ringdic.__version__
    }
