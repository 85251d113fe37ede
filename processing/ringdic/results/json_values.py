"""Arrays and numbers of numpy as JSON values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def json_value(value: Any) -> Any:
    """A value as nested dicts, lists and scalars: arrays become lists, numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): json_value(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [json_value(inner) for inner in value]
    if isinstance(value, np.generic):
        return json_value(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value
