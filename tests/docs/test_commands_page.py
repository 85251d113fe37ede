"""The page of commands has every command and every option, and no other."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from ringdic.cli.app import application
from typer.main import get_command

Table = Callable[[str, str], list[list[str]]]
EVERYWHERE = {"--help"}


def commands(group: Any, prefix: str = "ringdic") -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{prefix} {name}")
        else:
            yield f"{prefix} {name}", command


@pytest.fixture(scope="module")
def offered() -> dict[str, Any]:
    """All commands by name."""
    return dict(commands(get_command(application())))


@pytest.fixture(scope="module")
def described(table: Table) -> dict[str, str]:
    """What the page writes of each command of `ringdic`, by name."""
    texts: dict[str, str] = {}
    for heading in ("Sessions", "Building a rig", "Users of the page", "Archives", "Results of a session", "Studies"):
        for cell, _ in table("commands.md", heading):
            text = cell.strip("`").replace("\\|", "|")
            name = re.match(r"ringdic (?:(?:measure|rig|users|archive) )?\w+", text)
            assert name is not None, cell
            texts[name[0]] = text
    return texts


def test_every_command_is_described(offered: dict[str, Any], described: dict[str, str]) -> None:
    assert set(offered) == set(described)


def test_every_option_that_is_described_exists(offered: dict[str, Any], described: dict[str, str]) -> None:
    for name, text in described.items():
        known = {
            option for parameter in offered[name].params for option in (*parameter.opts, *parameter.secondary_opts)
        }
        assert set(re.findall(r"--[a-z][\w-]*", text)) <= known, name


def test_every_option_is_described(offered: dict[str, Any], described: dict[str, str]) -> None:
    for name, command in offered.items():
        options = {option for parameter in command.params for option in parameter.opts if option.startswith("--")}
        assert options - EVERYWHERE <= set(re.findall(r"--[a-z][\w-]*", described[name])), name
