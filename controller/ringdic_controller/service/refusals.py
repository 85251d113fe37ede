"""Errors for requests that are refused: each has one sentence for the operator, and nothing was changed."""

import errno

#: Error numbers of a disk or a quota that is full.
NO_ROOM = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG)
_NOT_WRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM)


class RefusedError(Exception):
    """The request cannot be carried out in the present state of the controller; the text says why."""


class NotFoundError(Exception):
    """The request names a session, capture, round, job or result that does not exist; the text says which."""


class BusyError(Exception):
    """The controller serves as many requests of this sort as it can; the text says what to do."""


def disk_sentence(error: OSError) -> str:
    """What the operator can do about an error of the disk that holds the archive, with the file that it hit."""
    where = f" ({error.filename})" if error.filename else ""
    if error.errno in NO_ROOM:
        return f"The disk of the archive is full{where}. Free some space on it, then ask again."
    if error.errno in _NOT_WRITABLE:
        return f"The archive cannot be written{where}. Make its folder writable for the controller, then ask again."
    reason = error.strerror or str(error)
    return f"The disk of the archive failed: {reason}{where}. Check that the disk is connected, then ask again."
