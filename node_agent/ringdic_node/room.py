"""What the spool held when the node started, and whether it has room for the captures to come."""

from __future__ import annotations

from pathlib import PurePath

from ringdic_node.spool import Spool, key_of_stem
from ringdic_node.wire import Failure

MIB = 1 << 20


class SpoolRoom:
    """Images of this node in its spool, those that cannot be used, and room for further ones.

    Parameters
    ----------
    spool : Spool
    node : str
        This node's id; images of another one, as on a card that was moved, stay in the spool and are not sent.
    captures : int
        Number of captures that must find room before the node arms.

    Attributes
    ----------
    waiting, delivered : tuple of Manifest
        This node's images without and with an acknowledgement, oldest first.
    failures : tuple of Failure
        Captures whose images are in the spool but cannot be used.
    image_bytes : int
        Size of one image; 0 where none has been seen.
    """

    def __init__(self, spool: Spool, node: str, captures: int) -> None:
        self._spool = spool
        self._captures = captures
        contents = spool.contents()
        self.waiting = tuple(manifest for manifest in contents.waiting if manifest.node == node)
        self.delivered = tuple(manifest for manifest in contents.delivered if manifest.node == node)
        self.image_bytes = max((manifest.bytes for manifest in (*self.waiting, *self.delivered)), default=0)
        self._foreign = sorted({manifest.node for manifest in contents.waiting} - {node})
        self._unread = contents.unread
        self._aside = spool.aside
        unread = ((key_of_stem(PurePath(name).stem), reason) for name, reason in contents.unread.items())
        self.failures = tuple(
            Failure(node, key, f"its image stays in the node's spool and cannot be sent: {reason}")
            for key, reason in unread
            if key is not None
        )

    def obstacle(self) -> str:
        """A sentence that says how much room is missing for the captures to come; empty if there is enough."""
        needed, free = self._captures * max(self.image_bytes, 1), self._spool.free
        if free >= needed:
            return ""
        return (
            f"the spool {self._spool.folder} has room for {free // max(self.image_bytes, 1)} of {self._captures} "
            f"images ({free / MIB:.1f} of {needed / MIB:.1f} MiB): wait until its images are delivered, "
            "or remove other files from its disk"
        )

    def detail(self, unwanted: int) -> str:
        """What the operator should know of the spool, in sentences; empty if there is nothing.

        unwanted : number of images in it that the controller does not know.
        """
        sentences = []
        if self._unread:
            name, reason = next(iter(self._unread.items()))
            sentences.append(
                f"{len(self._unread)} images stay in the spool because they cannot be used, first {name}: {reason}"
            )
        if self._foreign:
            sentences.append(f"images of node {', '.join(self._foreign)} stay in the spool: was this card moved?")
        if self._aside:
            sentences.append(f"{self._aside} images without a manifest are kept in {self._spool.folder / 'aside'}")
        if unwanted:
            sentences.append(f"{unwanted} images of captures that the controller does not know stay in the spool")
        obstacle = self.obstacle()
        return "; ".join([*sentences, obstacle] if obstacle else sentences)
