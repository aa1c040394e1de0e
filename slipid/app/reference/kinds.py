"""Types of keys in words: what a value of a config may look like."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from slipid.app.reference.parameters import keys, meaning

_PLAIN = {
    str: "text",
    Path: "text",
    bool: "true or false",
    int: "whole number",
    float: "number",
    object: "anything",
    NoneType: "nothing",
}


@dataclass(frozen=True)
class Key:
    """A key of a config: its name, what its value may be, its default in words, its meaning."""

    name: str
    kind: str
    default: str
    means: str


def keys_of(kind: type, hidden: tuple[str, ...] = ()) -> list[Key]:
    """Every key of a model or a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    named = {_declared(kind, key): key for key in keys(kind) if key not in hidden}
    return [
        Key(
            key,
            in_words(hints[name], _of_field(kind, name)),
            _default(kind, name),
            _means(kind, key, hints[name]),
        )
        for name, key in named.items()
    ]


def _declared(kind: type, key: str) -> str:
    """Name of the attribute that a key is read into."""
    if not issubclass(kind, BaseModel):
        return key
    return next(name for name, field in kind.model_fields.items() if (field.alias or name) == key)


def _of_field(kind: type, name: str) -> tuple[object, ...]:
    """Limits that a field of a model has beside its type."""
    return tuple(kind.model_fields[name].metadata) if issubclass(kind, BaseModel) else ()


def _means(kind: type, key: str, hint: object) -> str:
    """What a key means; of one that has few values only, these are said by its type."""
    return "" if key == "drive" and get_origin(hint) is Literal else meaning(kind, key)


def in_words(hint: object, limits: tuple[object, ...] = ()) -> str:
    """A type as people say it."""
    origin, inside = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return in_words(inside[0], (*limits, *inside[1:]))
    if origin in (Union, UnionType):
        words = dict.fromkeys(in_words(one, limits) for one in inside if one is not NoneType)
        return " or ".join(words)
    if origin is Literal:
        return " or ".join(f'"{value}"' for value in inside)
    if origin in (list, tuple):
        return _list(inside, limits)
    if origin is not None and issubclass(origin, Mapping):
        return f"table of ({in_words(inside[1])})"
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return "table"
    if hint in _PLAIN and isinstance(hint, type):
        return _PLAIN[hint] + _limits(limits)
    return "table"


def _list(inside: tuple[object, ...], limits: tuple[object, ...]) -> str:
    """A list, of a number of members where it has one."""
    members = [one for one in inside if one is not Ellipsis]
    element = in_words(members[0])
    # one alone may be written without the list
    alone = any(type(limit).__name__ == "BeforeValidator" for limit in limits)
    counted = len(members) > 1 and Ellipsis not in inside
    many = f"{len(members)} " if counted else _least(limits)
    listed = f"list of {many}({element})" if " " in element else f"list of {many}{element}s"
    return f"{element} or {listed}" if alone else listed


def _least(limits: tuple[object, ...]) -> str:
    least = next((one.min_length for one in _unpacked(limits) if isinstance(one, MinLen)), 0)
    most = next((one.max_length for one in _unpacked(limits) if isinstance(one, MaxLen)), None)
    if least == most:
        return f"{least} "
    return f"at least {least} " if least > 1 else ""


def _limits(limits: tuple[object, ...]) -> str:
    signs = {Gt: (">", "gt"), Ge: (">=", "ge"), Lt: ("<", "lt"), Le: ("<=", "le")}
    said = {
        f"{sign} {getattr(one, attribute):g}"
        for one in _unpacked(limits)
        for kind, (sign, attribute) in signs.items()
        if isinstance(one, kind)
    }
    return f" {' and '.join(sorted(said, reverse=True))}" if said else ""


def _unpacked(limits: tuple[object, ...]) -> list[object]:
    """What pydantic keeps of `Field(...)` as well as what stands alone."""
    return [m for one in limits for m in (one.metadata if isinstance(one, FieldInfo) else [one])]


def _default(kind: type, name: str) -> str:
    """The default in words; "required" where there is none."""
    if issubclass(kind, BaseModel):
        field = kind.model_fields[name]
        made = field.get_default(call_default_factory=True)
        return "required" if made is PydanticUndefined else _said(made)
    assert is_dataclass(kind)
    one = next(f for f in fields(kind) if f.name == name)
    if one.default_factory is not MISSING:
        return _said(one.default_factory())
    return "required" if one.default is MISSING else _said(one.default)


def _said(value: object) -> str:
    """A value as a config has it."""
    if value is None or value in ({}, [], ()) or isinstance(value, BaseModel):
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        parts = [_said(one) for one in value]
        return parts[0] if isinstance(value, tuple) and len(parts) == 1 else f"[{', '.join(parts)}]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if value != "" else '""'
