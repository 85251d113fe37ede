"""The file of users and tokens, and the commands that change it."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest
from ringdic.cli.app import application
from ringdic.errors import InputError
from ringdic_controller.access.users import UserFile
from typer.testing import CliRunner

PASSWORD = "four words are better"


def run(*arguments: str, sent: str = "") -> str:
    done = CliRunner().invoke(application(), ["users", *arguments], input=sent)
    if isinstance(done.exception, InputError):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def test_passwords_are_kept_as_argon2_and_tokens_as_hashes_in_a_file_of_its_owner(tmp_path: Path) -> None:
    path = tmp_path / "users.json"
    run("add", "anna", "--file", str(path), sent=f"{PASSWORD}\n")
    token = run("token", "script", "--role", "operator", "--file", str(path)).strip()
    text = path.read_text()
    assert PASSWORD not in text
    assert token not in text
    assert json.loads(text)["users"]["anna"]["password"].startswith("$argon2id$v=19$m=65536,")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    file = UserFile(path)
    assert file.check_password("anna", PASSWORD).role == "operator"
    assert file.check_password("anna", PASSWORD + "x") is None
    assert file.check_password("nobody", PASSWORD) is None
    assert file.check_token(token).role == "operator"
    assert file.check_token(token[:-1]) is None
    listed = json.loads(run("list", "--json", "--file", str(path)))["users"]
    assert [(row["name"], row["kind"], row["role"]) for row in listed] == [
        ("anna", "user", "operator"), ("script", "token", "operator"),
    ]  # fmt: skip


def test_a_change_counts_at_once(quick_hashes: None, tmp_path: Path) -> None:
    path = tmp_path / "users.json"
    run("add", "anna", "--file", str(path), sent=f"{PASSWORD}\n")
    file = UserFile(path)
    before = file.account("anna")
    run("add", "anna", "--role", "viewer", "--file", str(path), sent="another four words\n")
    after = file.account("anna")
    assert (before.role, after.role) == ("operator", "viewer")
    assert before.version != after.version
    run("remove", "anna", "--file", str(path))
    assert file.account("anna") is None
    with pytest.raises(InputError, match="neither a user nor a token 'anna'"):
        run("remove", "anna", "--file", str(path))


@pytest.mark.parametrize("password", ["", "short", "aaaaaaaaaaaa", "annalouise", "x" * 1001])
def test_weak_passwords_are_refused_and_nothing_is_written(quick_hashes: None, tmp_path: Path, password: str) -> None:
    path = tmp_path / "users.json"
    with pytest.raises(InputError, match="password"):
        run("add", "annalouise", "--file", str(path), sent=f"{password}\n")
    assert not path.exists()


@pytest.mark.parametrize("name", ["", "a b", "a/b", "<b>", "x" * 65])
def test_names_that_are_no_names_are_refused(quick_hashes: None, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="is not a name"):
        UserFile(tmp_path / "users.json").set_user(name, "viewer", PASSWORD)


def test_a_token_keeps_its_name_until_it_is_removed(tmp_path: Path) -> None:
    file = UserFile(tmp_path / "users.json")
    first = file.add_token("script", "viewer")
    with pytest.raises(InputError, match="already"):
        file.add_token("script", "operator")
    file.remove("script")
    assert file.check_token(first) is None


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "damaged"),
        ("[" * 100_000, "damaged"),
        ('{"schema": 2, "secret": "' + "s" * 40 + '"}', "schema"),
        ('{"schema": 1}', "secret"),
        ('{"schema": 1, "secret": "short"}', "secret"),
        ('{"schema": 1, "secret": "' + "s" * 40 + '", "users": {"a": {"role": "root"}}}', "role"),
    ],
)
def test_a_damaged_file_lets_nobody_in_and_is_named(tmp_path: Path, text: str, word: str) -> None:
    path = tmp_path / "users.json"
    path.write_text(text)
    with pytest.raises(InputError, match=word) as refusal:
        UserFile(path).check_token("x")
    assert str(path) in str(refusal.value)
