"""Processes that speak as one node: one by right; two if a node's card was cloned or its id was given twice."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class _Process:
    """One run of a node's program: when it was seen first and heard last, ns, and where it runs."""

    seen_ns: int
    heard_ns: int = -1
    host: str = ""
    address: str = ""

    def __str__(self) -> str:
        return f"{self.host or 'a host without a name'} ({self.address or 'address not known'})"


class NodeProcesses:
    """The processes of one node that are alive by their liveliness tokens.

    The token of a process whose network was cut stays for seconds after its successor has appeared. Two processes
    count as two only if the older one has been heard since the newer one appeared. Times are those of the controller's
    monotonic clock, ns.
    """

    def __init__(self) -> None:
        self._processes: dict[str, _Process] = {}  # by instance, in the order of their appearance

    def __bool__(self) -> bool:
        return bool(self._processes)

    def appeared(self, instance: str, now_ns: int) -> None:
        """Note the token of a process."""
        self._processes.setdefault(instance, _Process(now_ns))

    def gone(self, instance: str) -> None:
        """Note that the token of a process is no more."""
        self._processes.pop(instance, None)

    def heard(self, instance: str, host: str, address: str, now_ns: int) -> None:
        """Note a message of a process, with the name and address of its host; ignored without its token."""
        process = self._processes.get(instance)
        if process is not None:
            process.heard_ns, process.host, process.address = now_ns, host, address

    def contradiction(self, node: str) -> str:
        """A sentence that names the hosts if two processes speak as the node at once; else empty."""
        processes = list(self._processes.values())
        speaking = [
            process
            for place, process in enumerate(processes)
            if process is processes[-1] or any(process.heard_ns > newer.seen_ns for newer in processes[place + 1 :])
        ]
        if len(speaking) < 2:
            return ""
        return (
            f"{len(speaking)} nodes have the id {node}: {', '.join(str(process) for process in speaking)}; "
            "switch off all but one, or give each an id of its own in its node.toml"
        )
