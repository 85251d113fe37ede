"""JSON objects from a peer or from the disk made harmless, and frozen dataclasses built from them.

What arrives may have been written by another release or by a stranger. Fields that a class does not know are no
fault. Numbers that are not finite or are immense, characters that are none and tables nested too deeply
become null or a replacement, so that whatever is decoded can be stored, compared and sent on as JSON.

Standard library only.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

MAX_DOCUMENT = 16 << 20  # bytes
MAX_DEPTH = 16
MAX_TEXT = 4000  # characters; longer texts are cut
MAX_BITS = 256  # of an integer: it must still be a finite float
UNKNOWN = "unknown"  # name of a class's field that holds the fields of a document that the class does not know

#: By a field's annotation, the types of its JSON value.
_PLAIN: dict[str, type[Any] | tuple[type[Any], ...]] = {
    "str": str,
    "int": int,
    "bool": bool,
    "float | None": (int, float, type(None)),
    "int | None": (int, type(None)),
    "dict[str, Any]": dict,
    "dict[str, str]": dict,
}


class WireError(ValueError):
    """A message that breaks the contract: the text says which field and why."""


def plain(value: Any, depth: int = MAX_DEPTH) -> Any:
    """A value as JSON can hold it: finite numbers, Unicode text, lists and tables of bounded depth.

    Other numbers and what is nested deeper than `depth` become None; other objects become their text.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value) if value.bit_length() <= MAX_BITS else None
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {_text(str(key)): plain(inner, depth - 1) for key, inner in value.items()} if depth else None
    if isinstance(value, list | tuple):
        return [plain(inner, depth - 1) for inner in value] if depth else None
    return _text(str(value))


def _text(text: str) -> str:
    if len(text) > MAX_TEXT:
        text = f"{text[:MAX_TEXT]}…"
    return text if text.isascii() else text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def read_document(payload: bytes) -> dict[str, Any]:
    """The JSON object in `payload`, made harmless by `plain`. Raises WireError for anything else."""
    if len(payload) > MAX_DOCUMENT:
        raise WireError(f"the message has {len(payload)} bytes; no message has more than {MAX_DOCUMENT}")
    try:
        document = plain(json.loads(payload))
    except ValueError as error:
        raise WireError(f"the message is not JSON: {error}") from error
    except RecursionError as error:
        raise WireError("the message is not usable: it is nested too deeply") from error
    if not isinstance(document, dict):
        raise WireError(f"the message is not a JSON object: {shown(document)}")
    return document


def shown(value: Any) -> str:
    """A value in a sentence: its representation, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:100]}…"


def document_of(record: Any) -> dict[str, Any]:
    """The fields of a dataclass as a JSON object, with those that it was built with and does not know."""
    names = [each.name for each in dataclasses.fields(record)]
    known = {name: _value_of(getattr(record, name)) for name in names if name != UNKNOWN}
    return {**known, **getattr(record, UNKNOWN, {})}


def _value_of(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return document_of(value)
    return [_value_of(each) for each in value] if isinstance(value, tuple) else value


def build(cls: type[Any], kind: str, document: Mapping[str, Any], nested: Mapping[tuple[str, str], type[Any]]) -> Any:
    """A dataclass from the fields of a JSON object; those that it does not know are kept or left out.

    Parameters
    ----------
    cls, kind : the class, and its name in sentences and in `nested`.
    document : the fields.
    nested : by kind and field, the class of the records in that field, which JSON alone does not tell from tables.

    Raises
    ------
    WireError
        A field is missing or has the wrong type.
    """
    fields = {each.name: each for each in dataclasses.fields(cls) if each.name != UNKNOWN}
    values: dict[str, Any] = {}
    for name, described in fields.items():
        if name in document:
            values[name] = _field(kind, name, str(described.type), document[name], nested)
        elif described.default is dataclasses.MISSING and described.default_factory is dataclasses.MISSING:
            raise WireError(f"{kind}: field {name!r} is missing")
    if any(each.name == UNKNOWN for each in dataclasses.fields(cls)):
        values[UNKNOWN] = {name: value for name, value in document.items() if name not in fields}
    return cls(**values)


def _field(kind: str, name: str, annotation: str, value: Any, nested: Mapping[tuple[str, str], type[Any]]) -> Any:
    where = f"{kind}: field {name!r}"
    record = nested.get((kind, name))
    if record is not None and value is None and annotation.endswith("| None"):
        return None
    if annotation.startswith("tuple"):
        if not isinstance(value, list):
            raise WireError(f"{where} must be a list, not {shown(value)}")
        return tuple(value if record is None else [_record(where, record, item, nested) for item in value])
    if record is not None:
        return _record(where, record, value, nested)
    types = _PLAIN[annotation]
    if not isinstance(value, types) or (isinstance(value, bool) and annotation != "bool"):
        raise WireError(f"{where} must be {annotation}, not {shown(value)}")
    return value


def _record(where: str, cls: type[Any], value: Any, nested: Mapping[tuple[str, str], type[Any]]) -> Any:
    if not isinstance(value, dict):
        raise WireError(f"{where} must be an object, not {shown(value)}")
    return build(cls, getattr(cls, "TYPE", "capture key"), value, nested)
