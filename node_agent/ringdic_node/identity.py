"""Which process speaks as a node, and where it runs, so that two nodes with one id are told apart."""

from __future__ import annotations

import re
import secrets
import socket
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Identity:
    """One run of the node's program: a random name, the host's name, and the controller's Zenoh endpoint."""

    controller: str
    instance: str = field(default_factory=lambda: secrets.token_hex(8))
    host: str = field(default_factory=socket.gethostname)

    @property
    def address(self) -> str:
        """Address of this host on the way to the controller; empty while there is no way. No packet is sent."""
        endpoint = re.match(r"\w+/\[?(.+?)\]?:(\d+)(#|$)", self.controller)
        if endpoint is None:
            return ""
        try:
            for family, kind, _, _, address in socket.getaddrinfo(
                endpoint[1], int(endpoint[2]), type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST
            ):
                with socket.socket(family, kind) as probe:
                    probe.connect(address)
                    return str(probe.getsockname()[0])
        except OSError:
            pass
        return ""

    def fields(self) -> dict[str, str]:
        """The fields ``instance``, ``host`` and ``address`` of a message."""
        return {"instance": self.instance, "host": self.host, "address": self.address}
