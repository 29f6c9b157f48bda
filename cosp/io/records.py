"""Frozen dataclasses to JSON files and back."""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cosp.errors import InputError
from cosp.io.temporary import temporary_for

RecordT = TypeVar("RecordT")


def write(path: str | Path, record: Any) -> None:
    """Write a record or a plain dictionary as JSON, whole or not at all.

    A record's file starts with its `kind` and `version`. Numbers that are not finite become null.
    """
    write_text(path, json.dumps(as_plain(record), indent=2, allow_nan=False) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all."""
    path = Path(path)
    temporary = temporary_for(path)
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def read_json(path: str | Path) -> dict[str, Any]:
    """The plain content of a JSON file.

    Raises
    ------
    InputError
        If the file is missing or is not a JSON object.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a whole JSON file ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def read(path: str | Path, kind: type[RecordT]) -> RecordT:
    """Read a record of a given class.

    Raises
    ------
    InputError
        If the file is of another kind or version, or lacks a field.
    """
    return from_plain(read_json(path), kind, str(path))


def as_plain(value: Any) -> Any:
    """What JSON can hold: dictionaries, lists, strings, numbers, null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = getattr(value, "KIND", None)
        head = {} if kind is None else {"kind": kind, "version": getattr(value, "VERSION", 1)}
        fields = {f.name: as_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {**head, **fields}
    if isinstance(value, dict):
        return {str(k): as_plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return as_plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [as_plain(v) for v in value]
    if isinstance(value, np.generic):
        return as_plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def from_plain(content: dict[str, Any], kind: type[RecordT], where: str) -> RecordT:
    """A record from the plain content of its file; `where` names the file in errors."""
    expected = (getattr(kind, "KIND", None), getattr(kind, "VERSION", None))
    found = (content.get("kind"), content.get("version"))
    if expected[0] is not None and found != expected:
        raise InputError(
            f"{where}: expected kind {expected[0]!r} version {expected[1]}, found kind {found[0]!r} version {found[1]}"
        )
    hints = typing.get_type_hints(kind)
    values = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if field.name in content:
            values[field.name] = _revive(content[field.name], hints[field.name], f"{where}: {field.name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise InputError(f"{where}: field {field.name!r} is missing")
    return kind(**values)


def _revive(value: Any, hint: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        options = [o for o in typing.get_args(hint) if o is not type(None)]
        return None if value is None else _revive(value, options[0], where)
    if dataclasses.is_dataclass(hint):
        return from_plain(value, typing.cast(type[Any], hint), where)
    if origin is tuple:
        inner = typing.get_args(hint)
        hints = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else list(inner)
        return tuple(_revive(v, h, where) for v, h in zip(value, hints, strict=True))
    if origin is list:
        return [_revive(v, typing.get_args(hint)[0], where) for v in value]
    if origin is dict:
        return {k: _revive(v, typing.get_args(hint)[1], where) for k, v in value.items()}
    if origin is np.ndarray:
        # The scalar type of an array hint is its last argument's own argument.
        arguments = typing.get_args(typing.get_args(hint)[1])
        scalar = arguments[0] if arguments and isinstance(arguments[0], type) else np.float64
        return np.array(value, dtype=None if scalar is np.floating or scalar is np.integer else scalar)
    if hint is float and value is None:
        return float("nan")
    return float(value) if hint is float and isinstance(value, (int, float)) else value
