"""Errors for requests that are refused: each has one sentence for the operator, and nothing was changed."""


class RefusedError(Exception):
    """The request cannot be carried out in the present state of the controller; the text says why."""


class NotFoundError(Exception):
    """The request names a session, capture, round, job or result that does not exist; the text says which."""
