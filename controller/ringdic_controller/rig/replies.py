"""Messages in the replies of nodes over Zenoh."""

from __future__ import annotations

import logging
from typing import Any

import zenoh
from ringdic_node.wire import Inventory, WireError, decode_as

log = logging.getLogger(__name__)


def decoded(reply: zenoh.Reply, answer: type[Any]) -> Any | None:
    """The message in a reply; None, with a line in the log, for an error or a message that breaks the contract."""
    if reply.ok is None:
        reason = reply.err.payload.to_string() if reply.err else "no reason given"
        log.warning("a question to a node went without its answer: %s", reason)
        return None
    try:
        message = decode_as(answer, reply.ok.payload.to_bytes())
    except WireError as error:
        log.warning("an answer on %s breaks the contract: %s", reply.ok.key_expr, error)
        return None
    return message.own_part() if isinstance(message, Inventory) else message
