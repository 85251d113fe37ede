"""Logins of users: a password becomes a signed cookie, good until it is old or ended, or the user has changed."""

from __future__ import annotations

import asyncio
import hashlib
import secrets
import time
from collections.abc import Callable

from itsdangerous import BadData, URLSafeTimedSerializer

from ringdic_controller.access.attempts import AttemptLimit, network_of
from ringdic_controller.access.users import Account, UserFile

LOGIN_LASTS = 12 * 3600  # seconds
ATTEMPTS_OF_ADDRESS = (10, 300.0)  # failed attempts within seconds
ATTEMPTS_FOR_NAME = (30, 300.0)
AT_A_TIME = 2  # passwords that are looked at at a time: each takes 64 MiB
WAITING = 20  # logins that may wait for that
TURN = 2.0  # seconds until it is worth trying again


class TooManyAttemptsError(Exception):
    """Too many logins. seconds : until the next attempt."""

    def __init__(self, seconds: float) -> None:
        self.seconds = int(seconds) + 1
        super().__init__(f"Too many attempts; try again in {self.seconds} s.")


class Logins:
    """Checks passwords and cookies of the users in a file.

    Parameters
    ----------
    users
        The users.
    monotonic
        The present time in s, for the limit of attempts.
    """

    def __init__(self, users: UserFile, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.users = users
        self._monotonic = monotonic
        self._by_address = AttemptLimit(*ATTEMPTS_OF_ADDRESS)
        self._by_name = AttemptLimit(*ATTEMPTS_FOR_NAME)
        self._turns = asyncio.Semaphore(AT_A_TIME)
        self._waiting = 0
        self._ended: dict[str, float] = {}  # login -> when its cookie is too old anyway, s of the monotonic clock

    def claim_attempt(self, name: str, address: str) -> None:
        """Note one attempt, before the password is looked at, so that attempts at a time are all counted.

        Raises TooManyAttemptsError if there have been too many from this address, or for this name.
        """
        now = self._monotonic()
        wait = self._by_address.wait(network_of(address), now) or self._by_name.wait(name, now)
        if wait:
            raise TooManyAttemptsError(wait)

    async def check(self, name: str, password: str) -> Account | None:
        """The account if the password is right; takes a while, on purpose, and only a few at a time are looked at.

        Raises TooManyAttemptsError if too many wait for their turn.
        """
        if self._waiting >= WAITING:
            raise TooManyAttemptsError(TURN)
        self._waiting += 1
        try:
            async with self._turns:
                return await asyncio.to_thread(self.users.check_password, name, password)
        finally:
            self._waiting -= 1

    def cookie(self, account: Account, address: str) -> str:
        """A new cookie for an account that has just shown its password."""
        self._by_address.forget(network_of(address))
        self._by_name.forget(account.name)
        return self._signer().dumps([account.name, account.version, secrets.token_urlsafe(12)])

    def account(self, cookie: str) -> Account | None:
        """The account of a cookie; None if it is forged, too old or ended, or the user has changed since."""
        entry = self._entry(cookie)
        if entry is None or entry[2] in self._ended:
            return None
        account = self.users.account(entry[0])
        return account if account is not None and secrets.compare_digest(account.version, entry[1]) else None

    def end(self, cookie: str) -> None:
        """End a login: its cookie is not good any more, wherever a copy of it is."""
        entry, now = self._entry(cookie), self._monotonic()
        self._ended = {login: until for login, until in self._ended.items() if until > now}
        if entry is not None:
            self._ended[entry[2]] = now + LOGIN_LASTS

    def _entry(self, cookie: str) -> tuple[str, str, str] | None:
        signer = self._signer()  # outside the try: a damaged file of users is no forged cookie
        try:
            name, version, login = signer.loads(cookie, max_age=LOGIN_LASTS)
        except (BadData, ValueError, TypeError):
            return None
        return (name, version, login) if all(isinstance(part, str) for part in (name, version, login)) else None

    def _signer(self) -> URLSafeTimedSerializer:
        return URLSafeTimedSerializer(
            self.users.secret, salt="ringdic login", signer_kwargs={"digest_method": hashlib.sha256}
        )
