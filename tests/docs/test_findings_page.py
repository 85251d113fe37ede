"""The page of findings lists every code with the verdict that it leads to, and no other."""

import re
from pathlib import Path

from ringdic.findings import CODES

PAGE = Path(__file__).parents[2] / "docs" / "pages" / "findings.md"


def test_every_code_is_listed_with_its_verdict_and_meaning() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| ([a-z ]+) \| (.+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == [(code, str(verdict), meaning) for code, (verdict, meaning) in CODES.items()]
