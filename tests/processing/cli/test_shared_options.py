"""Options that several commands share are offered one by one and handed to the command as one value."""

from pathlib import Path

import typer
from ringdic.cli.options import AsJson, FamilyChoice, Session, spread_options
from typer.main import get_command
from typer.testing import CliRunner


def test_a_group_of_options_is_offered_option_by_option_and_given_as_a_whole() -> None:
    given = []

    @spread_options
    def command(session: Session, *, choice: FamilyChoice, as_json: AsJson = False) -> None:
        """A command."""
        given.append((session, choice, as_json))

    app = typer.Typer()
    app.command()(command)
    names = [parameter.name for parameter in get_command(app).params]
    assert names[:7] == ["session", "run", "reference", "without_rigid_motion", "window", "seth_hill", "as_json"]
    for arguments, choice in (
        (["--seth-hill", "0.25", "--without-rigid-motion"], FamilyChoice(without_rigid_motion=True, seth_hill=0.25)),
        (["--run", "3", "--reference", "previous"], FamilyChoice(run=3, reference="previous")),
    ):
        assert CliRunner().invoke(app, ["folder", *arguments, "--json"]).exit_code == 0
        assert given.pop() == (Path("folder"), choice, True)
