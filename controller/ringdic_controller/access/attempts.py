"""Limit of attempts within a time, for each key: an address that guesses passwords, or a name whose are guessed."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict, deque

MOST_KEYS = 10_000


class AttemptLimit:
    """Counts attempts in a moving window of time. Times are s of the monotonic clock.

    Parameters
    ----------
    count
        Attempts that are allowed for one key within the window.
    window
        Length of the window, s.
    """

    def __init__(self, count: int, window: float) -> None:
        self._count = count
        self._window = window
        self._attempts: OrderedDict[str, deque[float]] = OrderedDict()

    def wait(self, key: str, now: float) -> float:
        """Note one attempt and return 0.0; or, if there were too many, note nothing and return s to wait."""
        past = self._attempts.setdefault(key, deque())
        self._attempts.move_to_end(key)
        while past and past[0] <= now - self._window:
            past.popleft()
        if len(past) >= self._count:
            return past[0] + self._window - now
        past.append(now)
        while len(self._attempts) > MOST_KEYS:
            self._attempts.popitem(last=False)
        return 0.0

    def forget(self, key: str) -> None:
        """Allow a key all attempts again."""
        self._attempts.pop(key, None)


def network_of(address: str) -> str:
    """The part of an address that somebody cannot choose: all of an IPv4 address, the first 64 bits of an IPv6 one."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 6 and parsed.ipv4_mapped is None:
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return str(getattr(parsed, "ipv4_mapped", None) or parsed)
