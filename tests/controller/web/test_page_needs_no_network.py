"""What is bundled names no other host, and its lock file pins every package without naming a registry."""

import json
import re
from pathlib import Path

import pytest
import ringdic_controller
from ringdic.session.names import CAPTURE_KINDS

WEB = Path(ringdic_controller.__file__).parent / "web"


def test_the_lock_file_pins_every_package_by_checksum_and_names_no_host() -> None:
    text = (WEB / "package-lock.json").read_text(encoding="utf-8")
    packages = {name: entry for name, entry in json.loads(text)["packages"].items() if name}
    assert {"node_modules/three", "node_modules/esbuild"} <= packages.keys()
    assert all(entry["integrity"].startswith("sha512-") for entry in packages.values())
    assert "resolved" not in text


@pytest.mark.parametrize("file", [*sorted(WEB.glob("src/*")), WEB / "index.html"], ids=lambda path: path.name)
def test_the_sources_of_the_page_name_no_other_host(file: Path) -> None:
    addresses = re.findall(r"https?://[\w./]+", file.read_text(encoding="utf-8"))
    assert set(addresses) <= {"http://www.w3.org/2000/svg"}


def test_the_page_has_a_button_for_each_kind_of_capture() -> None:
    listed = re.search(r"const KINDS = (\[.*?\]);", (WEB / "src" / "captures.js").read_text(encoding="utf-8"))
    assert listed is not None
    assert tuple(json.loads(listed[1])) == CAPTURE_KINDS
    buttons = re.findall(r'id="capture-\w+" data-kind="(\w+)"', (WEB / "index.html").read_text(encoding="utf-8"))
    assert tuple(buttons) == CAPTURE_KINDS
