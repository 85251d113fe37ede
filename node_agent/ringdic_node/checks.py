"""Checks of the fields of messages between node and controller. Standard library only."""

from __future__ import annotations

import re

from ringdic_node.json_document import WireError, shown

LARGEST = (1 << 63) - 1  # of the integers in messages

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_HASH = re.compile(r"[0-9a-f]{64}")


def valid_name(what: str, name: object) -> str:
    """Return `name` if it may stand in a key and in a file name, else raise WireError."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise WireError(
            f"{what} {shown(name)} is not a name: use 1 to 64 letters, digits, dots, dashes or underscores, "
            "beginning with a letter or a digit"
        )
    return name


def require_int(what: str, value: object, *, at_least: int = -LARGEST) -> None:
    """Raise WireError unless a value is an integer from `at_least` to `LARGEST`; `what` names the field."""
    if not isinstance(value, int) or isinstance(value, bool) or not at_least <= value <= LARGEST:
        raise WireError(f"{what} must be an integer of at least {at_least} and of 63 bits, not {shown(value)}")


def require_optional(message: object, *names: str, at_least: int = -LARGEST) -> None:
    """Raise WireError unless the fields of these names are None or integers, as `require_int` checks them."""
    for name in names:
        if getattr(message, name) is not None:
            require_int(name, getattr(message, name), at_least=at_least)


def require_in(what: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise WireError unless a value is one of those allowed."""
    if value not in allowed:
        raise WireError(f"{what} {shown(value)} is none of {', '.join(allowed)}")


def require_hash(what: str, value: object) -> None:
    """Raise WireError unless a value is a SHA-256 checksum in hexadecimal digits."""
    if not isinstance(value, str) or not _HASH.fullmatch(value):
        raise WireError(f"{what} must be 64 hexadecimal digits (SHA-256), not {shown(value)}")


def require_hash_if_given(what: str, value: object) -> None:
    """Raise WireError unless a value is empty or a SHA-256 checksum in hexadecimal digits."""
    if value != "":
        require_hash(what, value)


def require_table(what: str, value: object) -> None:
    """Raise WireError unless a value is a table with text keys."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise WireError(f"{what} must be a table with text keys, not {shown(value)}")


def require_texts(what: str, value: object) -> None:
    """Raise WireError unless a value is a table of texts with text keys."""
    require_table(what, value)
    assert isinstance(value, dict)
    if not all(isinstance(text, str) for text in value.values()):
        raise WireError(f"{what} must be a table of texts, not {shown(value)}")
