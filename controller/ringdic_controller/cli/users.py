"""The commands ``ringdic users …``: who may use the page, and tokens for scripts."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer
from ringdic.cli.console import print_json, say, show_table
from ringdic.cli.options import AsJson
from ringdic.errors import InputError

users_app = typer.Typer(name="users", help="Who may use the controller's page.", no_args_is_help=True)

Name = Annotated[str, typer.Argument(help="Name of the user or token.")]
UsersFile = Annotated[Path, typer.Option("--file", help="The file that controller.toml names as users.")]
AsRole = Annotated[Literal["operator", "viewer"], typer.Option("--role", help="An operator acts, a viewer looks.")]
FILE = Path("users.json")


@users_app.command("add")
def add_user_command(name: Name, role: AsRole = "operator", file: UsersFile = FILE) -> None:
    """Add a user, or change one's role and password. The password is asked for, or read from standard input."""
    from ringdic_controller.access.users import UserFile

    UserFile(file).set_user(name, role, _password(name))
    say(f"{name} may log in as {role}; earlier logins of that name have ended")


@users_app.command("token")
def add_token_command(name: Name, role: AsRole = "viewer", file: UsersFile = FILE) -> None:
    """Make a token for a script, and print it on standard output: it cannot be shown again."""
    from ringdic_controller.access.users import UserFile

    typer.echo(UserFile(file).add_token(name, role))
    say("send it as the header Authorization: Bearer TOKEN")


@users_app.command("remove")
def remove_user_command(name: Name, file: UsersFile = FILE) -> None:
    """Remove the user and the token of a name; it counts at once."""
    from ringdic_controller.access.users import UserFile

    UserFile(file).remove(name)
    say(f"{name} is removed from {file}")


@users_app.command("list")
def list_users_command(file: UsersFile = FILE, as_json: AsJson = False) -> None:
    """List users and tokens."""
    from ringdic_controller.access.users import UserFile

    rows = UserFile(file).rows()
    show_table(f"users of {file}", rows)
    if as_json:
        print_json({"users": rows})


def _password(name: str) -> str:
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    password = typer.prompt(f"Password of {name}", hide_input=True, err=True)
    if typer.prompt("Once more", hide_input=True, err=True) != password:
        raise InputError("the two passwords differ; nothing was changed")
    return str(password)
