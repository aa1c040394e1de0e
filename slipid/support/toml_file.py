"""TOML files checked against a pydantic model: every mistake on one line, with its key."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Literal,
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from slipid.support.content import Content
from slipid.support.errors import DataError

Model = TypeVar("Model")
Step = str | int
"""Key of a table, or place in a list."""


class Section(BaseModel):
    """A table of a config: only the keys it declares, and not to be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def text_of(path: Path, what: str = "a config") -> str:
    """Text of a file that should be of some kind.

    Raises:
        DataError: unreadable.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected {what} (TOML file)") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: no UTF-8 text; expected {what} (TOML file)") from error


def mapping_of(path: Path, text: str) -> Content:
    """What TOML text says.

    Raises:
        DataError: no TOML.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DataError(f"{path}: no valid TOML: {error}") from error


def content(path: Path, text: str, model: type[Model]) -> Model:
    """Text as a model.

    Args:
        path: for messages.
        text: TOML.
        model: what it should be.

    Raises:
        DataError: no TOML, unknown or missing keys, wrong values; every one on a line.
    """
    return checked(path, mapping_of(path, text), model)


def checked(path: Path | str, mapping: object, model: type[Model]) -> Model:
    """A mapping as a pydantic model or dataclass.

    Raises:
        DataError: unknown or missing keys, wrong values; every one on a line.
    """
    try:
        return TypeAdapter(model).validate_python(mapping)
    except ValidationError as error:
        lines = dict.fromkeys(_line(path, mapping, model, e) for e in error.errors())
        raise DataError("\n".join(lines)) from None


def _line(path: Path | str, mapping: object, root: type, error: ErrorDetails) -> str:
    """One mistake as one line: file, key, what was found, what was expected."""
    kind, given = error["type"], error["input"]
    steps = _steps(mapping, error["loc"])
    where = f"{path}: {_spelled(steps)}" if steps else str(path)
    context = error.get("ctx", {})
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _keys(_kind_at(mapping, root, steps[:-1]))
        near = get_close_matches(str(steps[-1]), known, n=2)
        hint = f", did you mean {' or '.join(near)}?" if near else ""
        return f"{where}: no such key{hint}; expected one of {', '.join(known)}"
    if kind in ("missing", "missing_argument"):
        return f"{where}: missing; expected a value for it"
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        key = context["discriminator"].strip("'")
        if kind == "union_tag_not_found":
            choices = [v for m in _kinds_at(mapping, root, steps) for v in _tags(m, key)]
            return f"{where}.{key}: missing; expected one of {', '.join(choices)}"
        choices = [tag.strip(" '") for tag in context["expected_tags"].split(",")]
        near = get_close_matches(str(context["tag"]), choices, n=1)
        hint = f", did you mean {near[0]}?" if near else ""
        expected = ", ".join(choices)
        return f"{where}.{key}: '{context['tag']}'{hint}; expected one of {expected}"
    if kind == "value_error":
        return f"{where}: {context['error']}"
    if kind == "literal_error":
        return f"{where}: {given!r}; expected one of {context['expected']}"
    return f"{where}: {given!r}; expected: {error['msg'][0].lower()}{error['msg'][1:]}"


def _steps(mapping: object, loc: Sequence[Step]) -> list[Step]:
    """The part of pydantic's location that is in the file: without names of union members."""
    steps: list[Step] = []
    here = mapping
    for k, part in enumerate(loc):
        if (isinstance(here, dict) and part in here) or (
            isinstance(here, list) and isinstance(part, int) and part < len(here)
        ):
            here = _below(here, part)
        elif k < len(loc) - 1 or not isinstance(here, dict):
            continue
        steps.append(part)
    return steps


def _spelled(steps: Sequence[Step]) -> str:
    out = ""
    for step in steps:
        if isinstance(step, int):
            out += f"[{step + 1}]"
        else:
            name = (
                f'"{step}"' if not str(step).replace("_", "").replace("-", "").isalnum() else step
            )
            out += f".{name}" if out else str(name)
    return out


def _below(here: object, step: Step) -> object:
    """What lies one step below; None where nothing does."""
    if isinstance(here, list) and isinstance(step, int):
        return here[step]
    return here[step] if isinstance(here, dict) else None


def _kind_at(mapping: object, root: type, steps: Sequence[Step]) -> type:
    """The model or dataclass that describes a place of the file."""
    here = mapping
    for step in steps:
        here = _below(here, step)
    found = _kinds_at(mapping, root, steps)
    fitting = [m for m in found if isinstance(here, dict) and _fits(m, here)]
    return (fitting or found)[0]


def _kinds_at(mapping: object, root: type, steps: Sequence[Step]) -> list[type]:
    """Models and dataclasses that may describe a place of the file."""
    found: list[object] = [root]
    here = mapping
    for step in steps:
        if isinstance(here, dict):
            found = [m for m in found if not _described(m) or _fits(m, here)]
        inner = [t for m in found for t in _inner(m, step)]
        found, here = inner, _below(here, step)
    return [m for t in found for m in _members(t) if _described(m)]


def _described(kind: object) -> TypeGuard[type]:
    return isinstance(kind, type) and (issubclass(kind, BaseModel) or is_dataclass(kind))


def _inner(kind: object, step: Step) -> list[object]:
    """Types of what lies one step below."""
    if _described(kind):
        annotation = _annotations(kind).get(str(step))
        return [] if annotation is None else _members(annotation)
    return _members(get_args(kind)[-1]) if get_origin(kind) in (list, dict) else []


def _members(annotation: object) -> list[object]:
    """Alternatives of a type."""
    if get_origin(annotation) in (Union, UnionType):
        return [m for a in get_args(annotation) for m in _members(a)]
    if get_origin(annotation) is Annotated:
        return _members(get_args(annotation)[0])
    return [annotation]


def _annotations(kind: type) -> dict[str, object]:
    if issubclass(kind, BaseModel):
        return {f.alias or name: f.annotation for name, f in kind.model_fields.items()}
    assert is_dataclass(kind)
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind)}


def _tags(kind: type, key: str) -> tuple[str, ...]:
    return get_args(_annotations(kind).get(key, ()))


def _fits(kind: type, here: Mapping[str, object]) -> bool:
    """Whether its literals are those of the file."""
    return all(
        here[key] in get_args(annotation)
        for key, annotation in _annotations(kind).items()
        if get_origin(annotation) is Literal and key in here
    )


def _keys(kind: type) -> list[str]:
    return list(_annotations(kind))
