"""The settings page has every setting with its default, and no other."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path

from ringdic.settings import Settings, load_settings

ABOVE = {"method", "accept"}  # all groups


def test_the_table_is_that_of_the_program(table: Callable[[str, str], list[list[str]]]) -> None:
    shown: dict[str, object] = {}
    for names, default, _ in table("settings.md", "Settings of the processing"):
        keys = re.findall(r"`([\w.]+)`", names)
        group = keys[0].partition(".")[0]
        values = [tomllib.loads(f"x = {value.strip('`')}")["x"] for value in default.split(", ")]
        values *= len(keys) if len(values) == 1 else 1
        for key, value in zip(keys, values, strict=True):
            shown[key if "." in key or key in ABOVE else f"{group}.{key}"] = value
    groups = Settings().model_dump(exclude=ABOVE)
    known = {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}
    assert shown == {"method": Settings().method, "accept": list(Settings().accept), **known}


def test_the_example_is_read(pages: Path, tmp_path: Path) -> None:
    example = re.search(r"```toml\n(.*?)```", (pages / "settings.md").read_text(encoding="utf-8"), re.DOTALL)
    assert example is not None
    (tmp_path / "settings.toml").write_text(example[1], encoding="utf-8")
    assert load_settings(tmp_path / "settings.toml").correlation.radius_px == 14
