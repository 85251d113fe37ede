"""The file of those who may use the page and the HTTP interface: users with a password, and tokens for scripts.

It holds no secret that could be used as it is, but the key that signs the page's cookies: passwords are kept as argon2
hashes, tokens as SHA-256. Only its owner may read it. A change counts at once, also for whoever has logged in before.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, get_args

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass
from ringdic.errors import InputError
from ringdic.session.names import checked_name
from ringdic.settings import TABLE, faults

Role = Literal["operator", "viewer"]
ROLES: tuple[Role, ...] = get_args(Role)
SHORTEST_PASSWORD = 10
LONGEST_PASSWORD = 1000  # a longer one would only cost time
TOKEN_MARK = "rdic_"  # begins every token, so that a program that looks for lost secrets can find it

_hasher = PasswordHasher()


@dataclass(frozen=True)
class Account:
    """Somebody who may use the page. version : changes with the password, so that logins from before end with it."""

    name: str
    role: Role
    version: str = ""


@checked_dataclass(frozen=True, config=TABLE)
class _User:
    role: Role
    password: str
    changed: str


@checked_dataclass(frozen=True, config=TABLE)
class _Token:
    role: Role
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    made: str


@checked_dataclass(frozen=True, config=TABLE)
class _UsersJson:
    schema: Literal[1]
    secret: Annotated[str, Field(min_length=32)]
    users: dict[str, _User] = field(default_factory=dict)
    tokens: dict[str, _Token] = field(default_factory=dict)


_USERS_JSON = TypeAdapter(_UsersJson)


class UserFile:
    """The users and tokens in a JSON file; read again whenever the file has changed.

    Methods that read raise InputError for a file that is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._known: tuple[tuple[int, int, int], _UsersJson] | None = None

    # Asked by the controller

    @property
    def secret(self) -> str:
        """The key that signs cookies."""
        return self._read().secret

    def account(self, name: str) -> Account | None:
        """The account of a user; None if there is none of the name."""
        user = self._read().users.get(name)
        return None if user is None else _account(name, user)

    def check_password(self, name: str, password: str) -> Account | None:
        """The account of a user if the password is right, else None; takes as long for a name that does not exist."""
        user = self._read().users.get(name)
        try:
            right = _hasher.verify(user.password if user else _password_of_nobody(), password[:LONGEST_PASSWORD])
        except (VerificationError, InvalidHashError):
            return None
        return _account(name, user) if user and right else None

    def check_token(self, token: str) -> Account | None:
        """The account of a token; None for one that is not known."""
        given = hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
        for name, known in self._read().tokens.items():
            if secrets.compare_digest(given, known.sha256):
                return Account(f"token {name}", known.role)
        return None

    # Asked by the administrator

    def rows(self) -> list[dict[str, str]]:
        """One dictionary for each user and token: name, what it is, role, since when."""
        file = self._read()
        users = [
            {"name": name, "kind": "user", "role": user.role, "since": user.changed}
            for name, user in file.users.items()
        ]
        tokens = [
            {"name": name, "kind": "token", "role": token.role, "since": token.made}
            for name, token in file.tokens.items()
        ]
        return users + tokens

    def set_user(self, name: str, role: Role, password: str) -> None:
        """Add a user, or change role and password of one that exists. Raises InputError for a weak password."""
        checked_name("the user's name", name)
        if not SHORTEST_PASSWORD <= len(password) <= LONGEST_PASSWORD:
            raise InputError(f"the password must have {SHORTEST_PASSWORD} to {LONGEST_PASSWORD} characters")
        if password.lower() == name.lower() or len(set(password)) < 4:
            raise InputError("the password is too easy to guess; take several words")
        file = self._read_or_new()
        user = _User(role, _hasher.hash(password), _now())
        self._write(replace(file, users={**file.users, name: user}))

    def add_token(self, name: str, role: Role) -> str:
        """Make a token for a script and return it; it cannot be shown again. Raises InputError if the name is taken."""
        checked_name("the token's name", name)
        file = self._read_or_new()
        if name in file.tokens:
            raise InputError(f"there is a token '{name}' already; remove it first, or choose another name")
        token = TOKEN_MARK + secrets.token_urlsafe(32)
        entry = _Token(role, hashlib.sha256(token.encode()).hexdigest(), _now())
        self._write(replace(file, tokens={**file.tokens, name: entry}))
        return token

    def remove(self, name: str) -> None:
        """Remove the user and the token of a name. Raises InputError if there is neither."""
        file = self._read()
        if name not in file.users and name not in file.tokens:
            raise InputError(f"{self.path} has neither a user nor a token '{name}'")
        users = {key: user for key, user in file.users.items() if key != name}
        self._write(replace(file, users=users, tokens={k: token for k, token in file.tokens.items() if k != name}))

    # The file

    def _read_or_new(self) -> _UsersJson:
        return self._read() if self.path.exists() else _UsersJson(schema=1, secret=secrets.token_urlsafe(48))

    def _read(self) -> _UsersJson:
        try:
            found = self.path.stat()
            state = (found.st_mtime_ns, found.st_size, found.st_ino)
            known = self._known  # replaced as a whole: needs no lock
            if known is not None and known[0] == state:
                return known[1]
            file = _USERS_JSON.validate_python(json.loads(self.path.read_text(encoding="utf-8")))
        except FileNotFoundError as error:
            raise InputError(f"{self.path}: no such file; 'ringdic users add NAME' makes it") from error
        except OSError as error:
            raise InputError(f"{self.path} cannot be read ({error.strerror}); check who owns it") from error
        except ValidationError as error:
            raise InputError(f"{self.path}: {faults(error, _UsersJson)}") from error
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self.path} is damaged ({error}); put a copy back, or add the users anew") from error
        self._known = (state, file)
        return file

    def _write(self, file: _UsersJson) -> None:
        """Replace the file in one step; nobody but its owner may read it, and root leaves it to its owner."""
        content = json.dumps(_USERS_JSON.dump_python(file), indent=1) + "\n"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}.new")
        partial.unlink(missing_ok=True)
        with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as stream:
            if self.path.exists() and hasattr(os, "geteuid") and os.geteuid() == 0:
                owner = self.path.stat()
                os.fchown(stream.fileno(), owner.st_uid, owner.st_gid)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, self.path)


def _account(name: str, user: _User) -> Account:
    return Account(name, user.role, hashlib.sha256(user.password.encode()).hexdigest()[:16])


@lru_cache(maxsize=1)
def _password_of_nobody() -> str:
    return _hasher.hash(secrets.token_urlsafe(32))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
