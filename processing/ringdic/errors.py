"""What can go wrong, and whose it is to mend.

RingdicError
├── InputError        the images, the rig file or the settings are at fault: exit code 2
└── ComputationError  the input is sound but the answer cannot be computed: exit code 3
"""


class RingdicError(Exception):
    """A failure with a sentence for the operator: what, which file or camera, what to do."""

    exit_code = 1


class InputError(RingdicError, ValueError):
    """Bad input: an unknown key, a missing folder, an unreadable image, an empty mask."""

    exit_code = 2


class ComputationError(RingdicError, RuntimeError):
    """Sound input that does not determine the answer: no texture in common, a board seen from one side only."""

    exit_code = 3
