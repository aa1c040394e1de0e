"""JSON values as the types a dataclass declares, refused with their place where they are not."""

import sys
import typing
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

Kind = TypeVar("Kind")
_MOST = sys.float_info.max
_PLAIN = {bool: "true or false", str: "text", int: "a whole number", NoneType: "null"}


def typed(kind: type[Kind], value: object, where: str = "") -> Kind:
    """A JSON value as a dataclass, with every number finite, no key missing and none to spare.

    Args:
        kind: a dataclass of bool, int, float, str, None, `Literal`, tuples, mappings by str, unions
            and dataclasses.
        value: as `json.loads` gives it.
        where: its place, for messages.

    Raises:
        ValueError: something is missing, too much, or of another type; says where.
    """
    return _as(kind, value, where)


def _as(kind: Any, value: object, where: str) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return _one_of(inner, value, where)
    if origin is Literal:
        if not isinstance(value, str) or value not in inner:
            raise _wrong(where, value, " or ".join(repr(x) for x in inner))
        return value
    if origin is tuple:
        return _items(inner, value, where)
    if origin is Mapping:
        if not isinstance(value, dict):
            raise _wrong(where, value, "an object")
        return {k: _as(inner[1], v, f"{where}['{k}']") for k, v in value.items()}
    if is_dataclass(kind):
        return _object(kind, value, where)
    if kind is float:
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MOST:
            return float(value)
        raise _wrong(where, value, "a number")
    if type(value) is not kind:
        raise _wrong(where, value, _PLAIN[kind])
    return value


def _one_of(kinds: tuple[Any, ...], value: object, where: str) -> Any:
    if value is None and NoneType in kinds:
        return None
    *others, last = (k for k in kinds if k is not NoneType)
    for k in others:
        with suppress(ValueError):
            return _as(k, value, where)
    return _as(last, value, where)


def _items(inner: tuple[Any, ...], value: object, where: str) -> tuple[Any, ...]:
    endless = len(inner) == 2 and inner[1] is Ellipsis
    if not isinstance(value, list):
        raise _wrong(where, value, "a list")
    if not endless and len(value) != len(inner):
        raise ValueError(f"{where}: {len(value)} entries; expected {len(inner)}")
    kinds = [inner[0]] * len(value) if endless else inner
    return tuple(
        _as(k, v, f"{where}[{n}]") for n, (k, v) in enumerate(zip(kinds, value, strict=True))
    )


def _object(kind: Any, value: object, where: str) -> Any:
    if not isinstance(value, dict):
        raise _wrong(where, value, "an object")
    hints, before = typing.get_type_hints(kind), f"{where}." if where else ""
    names = [f.name for f in fields(kind)]
    for name in names:
        if name not in value:
            raise ValueError(f"{before}{name} is missing")
    for name in value:
        if name not in names:
            raise ValueError(f"{before}{name}: no such field; expected {', '.join(names)}")
    return kind(**{name: _as(hints[name], value[name], f"{before}{name}") for name in names})


def _wrong(where: str, value: object, expected: str) -> ValueError:
    shown = repr(value)
    shown = shown if len(shown) <= 40 else f"{shown[:37]}..."
    return ValueError(f"{where}: {shown}; expected {expected}")
