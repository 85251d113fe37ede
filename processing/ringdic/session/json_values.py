"""Arrays, numbers of numpy and dataclasses as JSON values, and dataclasses from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")


def json_value(value: Any) -> Any:
    """A value as nested dicts, lists and scalars: arrays become lists, numbers that are not finite become None."""
    if type(value) is float:  # by far the most, in matrices
        return value if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return json_value({each.name: getattr(value, each.name) for each in fields(value)})
    if isinstance(value, dict):
        return {str(key): json_value(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return json_value(value.tolist())
    if isinstance(value, list | tuple):
        return [json_value(inner) for inner in value]
    return value


def from_json_value(kind: type[T], values: Mapping[str, Any]) -> T:
    """The dataclass whose fields have these JSON values, as :func:`json_value` makes them; None stands for NaN.

    kind : the dataclass; its fields are numbers, text, tuples, arrays and dataclasses. values : by the fields' names;
    others are ignored. Raises KeyError for a field that is missing, ValueError or TypeError for another kind of value.
    """
    hints = get_type_hints(kind)
    return kind(**{each.name: _of_kind(hints[each.name], values[each.name]) for each in fields(kind)})  # type: ignore[arg-type]


def _of_kind(hint: Any, value: Any) -> Any:
    """The value of a field from its JSON value. hint : the field's type."""
    if is_dataclass(hint):
        return from_json_value(hint, value)  # type: ignore[arg-type]
    if get_origin(hint) is np.ndarray:  # NDArray[kind] is ndarray[shape, dtype[kind]]
        return np.array(value, dtype=get_args(get_args(hint)[1])[0])
    if get_origin(hint) is tuple:
        return tuple(get_args(hint)[0](each) for each in value)
    return float("nan") if value is None else hint(value)
