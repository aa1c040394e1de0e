"""TOML files checked against a pydantic model: every mistake on one line, with its key."""

import tomllib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from slipid.support.content import Content
from slipid.support.errors import DataError, near

CLOSED = ConfigDict(extra="forbid")
"""Of a dataclass that a config declares: other keys are refused."""
Positive = Annotated[float, Field(gt=0, strict=True, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, strict=True, allow_inf_nan=False)]
Part = Annotated[float, Field(ge=0, lt=1)]
"""Of a whole."""
Model = TypeVar("Model")
Step = str | int
"""Key of a table, or place in a list."""


class Section(BaseModel):
    """A table of a config: only the keys it declares, and not to be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def text_of(path: Path, what: str = "a config") -> str:
    """Text of a file that should be of some kind; DataError where it is unreadable."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected {what} (TOML file)") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: no UTF-8 text; expected {what} (TOML file)") from error


def mapping_of(path: Path, text: str) -> Content:
    """What TOML text says; DataError where it is no TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DataError(f"{path}: no valid TOML: {error}") from error


def checked(path: Path | str, mapping: object, model: type[Model]) -> Model:
    """A mapping as a pydantic model or dataclass; DataError with every mistake on a line."""
    try:
        return TypeAdapter(model).validate_python(mapping)
    except ValidationError as error:
        lines = dict.fromkeys(_line(path, model, e) for e in error.errors())
        raise DataError("\n".join(lines)) from None


def _line(path: Path | str, root: type, error: ErrorDetails) -> str:
    """One mistake as one line: file, key, what was found, what was expected."""
    kind, given, context = error["type"], error["input"], error.get("ctx", {})
    steps, there = _place(root, error["loc"])
    where = f"{path}: {_spelled(steps)}" if steps else str(path)
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        _, (model, *_) = _place(root, error["loc"][:-1])
        known = list(_annotations(model))
        return f"{where}: no such key{near(steps[-1], known)}; expected one of {', '.join(known)}"
    if kind in ("missing", "missing_argument"):
        return f"{where}: missing; expected a value for it"
    if kind == "union_tag_not_found":
        key = context["discriminator"].strip("'")
        tags = [get_args(_annotations(model)[key]) for model in there]
        return f"{where}.{key}: missing; expected one of {', '.join(v for t in tags for v in t)}"
    if kind == "union_tag_invalid":
        key, tag = context["discriminator"].strip("'"), context["tag"]
        choices = [known.strip(" '") for known in context["expected_tags"].split(",")]
        return f"{where}.{key}: '{tag}'{near(tag, choices)}; expected one of {', '.join(choices)}"
    if kind == "value_error":
        return f"{where}: {context['error']}"
    if kind == "literal_error":
        return f"{where}: {given!r}; expected one of {context['expected']}"
    return f"{where}: {given!r}; expected: {error['msg'][0].lower()}{error['msg'][1:]}"


def _place(root: object, loc: Sequence[Step]) -> tuple[list[Step], list[object]]:
    """The part of pydantic's location that is in the file, and the types that may be there.

    Tags and names of union members are not in the file.
    """
    steps: list[Step] = []
    kinds = [root]
    for k, part in enumerate(loc):
        tagged = [kind for kind in kinds if _has_tag(kind, part)]
        if len(kinds) > 1 and tagged:
            kinds = tagged
            continue
        inner = [t for kind in kinds for t in _inner(kind, part)]
        is_unknown_key = k == len(loc) - 1 and any(_annotations(kind) for kind in kinds)
        if inner or isinstance(part, int) or is_unknown_key:
            steps.append(part)
            kinds = inner
    return steps, kinds


def _spelled(steps: Sequence[Step]) -> str:
    out = ""
    for step in steps:
        if isinstance(step, int):
            out += f"[{step + 1}]"
        else:
            plain = step.replace("_", "").replace("-", "").isalnum()
            out += f".{step}" if plain else f'."{step}"'
    return out.removeprefix(".")


def _inner(kind: object, step: Step) -> list[object]:
    """Types of what lies one step below."""
    if get_origin(kind) is dict or (get_origin(kind) is list and isinstance(step, int)):
        return _members(get_args(kind)[-1])
    return _members(annotation) if (annotation := _annotations(kind).get(str(step))) else []


def _members(annotation: object) -> list[object]:
    """Alternatives of a type."""
    if get_origin(annotation) in (Union, UnionType):
        return [m for a in get_args(annotation) for m in _members(a)]
    return (
        _members(get_args(annotation)[0]) if get_origin(annotation) is Annotated else [annotation]
    )


def _annotations(kind: object) -> dict[str, object]:
    """Types of what a model or a dataclass holds, by key; empty for others."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {f.alias or name: f.annotation for name, f in kind.model_fields.items()}
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return {f.name: hints[f.name] for f in fields(kind)}
    return {}


def _has_tag(kind: object, tag: Step) -> bool:
    """Whether a literal of the model is this tag."""
    return any(
        get_origin(annotation) is Literal and tag in get_args(annotation)
        for annotation in _annotations(kind).values()
    )
