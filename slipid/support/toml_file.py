"""Checking of TOML files against pydantic models; the error has a line for each mistake."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from slipid.support.content import Content
from slipid.support.errors import DataError, did_you_mean, shown
from slipid.support.files import read_bytes
from slipid.support.parsing import Step, spelled, toml_of

CLOSED = ConfigDict(extra="forbid")
"""Pydantic config of dataclasses that describe tables of a TOML file: unknown keys are errors."""
_MOST_BYTES = 4 * 2**20
Model = TypeVar("Model")


class Section(BaseModel):
    """A table of a config: immutable, and without other keys than the declared ones."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def text_of(path: Path, what: str = "a config") -> str:
    """Return the text of a file; raise `DataError`, naming the expected `what`, if unreadable."""
    try:
        return read_bytes(path, f"{what} (TOML file)", _MOST_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text; expected {what} (TOML file)") from error


def mapping_of(path: Path, text: str) -> Content:
    """Return the content of a TOML text; raise `DataError` as `toml_of` raises `ValueError`."""
    try:
        return toml_of(text)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def checked(
    path: Path | str, mapping: object, model: type[Model], *, strict: bool = False
) -> Model:
    """Return a mapping as an instance of a pydantic model or dataclass.

    Args:
        path: file, or name of the section, for messages.
        mapping: content of the file or section.
        model: type of the result.
        strict: True for content of JSON, in which a number is not accepted as a string or vice
            versa.

    Raises:
        DataError: the mapping does not match the model; every mistake is a line of the message.
    """
    try:
        if strict:
            return TypeAdapter(model).validate_json(json.dumps(mapping), strict=True)
        return TypeAdapter(model).validate_python(mapping)
    except ValidationError as error:
        errors = _of_one_member(mapping, error.errors())
        raise DataError(*dict.fromkeys(_line(path, mapping, model, e) for e in errors)) from None


def _of_one_member(mapping: object, errors: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Return the errors without those of the other member of a union of a number and a list.

    Pydantic reports that the number 0 is no list besides that it is too small, and that a list is
    no number besides what is wrong in the list.
    """
    places = [_steps(mapping, error["loc"], missing=False) for error in errors]

    def foreign(k: int) -> bool:
        kind, is_list = errors[k]["type"], isinstance(errors[k]["input"], list)
        if kind not in (("value_error",) if is_list else ("list_type",)):
            return False
        inside = (j for j, place in enumerate(places) if place[: len(places[k])] == places[k])
        return any(len(places[j]) > len(places[k]) or errors[j]["type"] != kind for j in inside)

    return [error for k, error in enumerate(errors) if not foreign(k)]


def _line(path: Path | str, mapping: object, root: type, error: ErrorDetails) -> str:
    """Return a line about one mistake: file, key, what was found and what was expected."""
    kind, given, context = error["type"], error["input"], error.get("ctx", {})
    steps = _steps(mapping, error["loc"], kind in ("missing", "missing_argument"))
    where = f"{path}: {spelled(steps)}" if steps else str(path)
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        known = [
            name for one in _kinds_at(mapping, root, steps[:-1])[:1] for name in _annotations(one)
        ]
        alike = did_you_mean(steps[-1], known)
        return f"{where}: no such key{alike}; expected one of {', '.join(known)}"
    if kind == "missing" and isinstance(error["loc"][-1], int) and isinstance(given, list | tuple):
        return f"{where}: {shown(list(given))}; expected more values than {len(given)}"
    if kind in ("missing", "missing_argument"):
        return f"{where}: missing; expected a value for it"
    if kind == "union_tag_not_found":
        key = context["discriminator"].strip("'")
        tags = [get_args(_annotations(m)[key]) for m in _kinds_at(mapping, root, steps)]
        return f"{where}.{key}: missing; expected one of {', '.join(v for t in tags for v in t)}"
    if kind == "union_tag_invalid":
        key, tag = context["discriminator"].strip("'"), context["tag"]
        choices = [known.strip(" '") for known in context["expected_tags"].split(",")]
        alike = did_you_mean(tag, choices)
        return f"{where}.{key}: '{tag}'{alike}; expected one of {', '.join(choices)}"
    if kind == "value_error":
        return f"{where}: {context['error']}"
    if kind == "literal_error":
        return f"{where}: {shown(given)}; expected one of {context['expected']}"
    return f"{where}: {shown(given)}; expected: {error['msg'][0].lower()}{error['msg'][1:]}"


def _steps(mapping: object, loc: Sequence[Step], missing: bool) -> list[Step]:
    """Return the steps to a mistake in the file, from the location that pydantic reports.

    Pydantic's location also has names of union members, which are omitted. If a key is `missing`,
    it is the last step, although the file does not have it.
    """
    steps: list[Step] = []
    here = mapping
    for k, part in enumerate(loc):
        if (isinstance(here, dict) and part in here) or (
            isinstance(here, list) and isinstance(part, int) and part < len(here)
        ):
            here = _below(here, part)
        elif not missing or k < len(loc) - 1 or not isinstance(here, dict):
            continue
        steps.append(part)
    return steps


def _below(here: object, step: Step) -> object:
    """Return the value one step below a value, or None if there is none."""
    if isinstance(here, list) and isinstance(step, int):
        return here[step]
    return here.get(step) if isinstance(here, dict) else None


def _kinds_at(mapping: object, root: object, steps: Sequence[Step]) -> list[object]:
    """Return the models and dataclasses that may describe the value at a location in the file.

    Of the members of a union, only those whose literals (such as `drive = "omni"`) match the file
    are returned.
    """
    found, here = [root], mapping
    for step in steps:
        inner = [t for kind in found for t in _inner(kind, step)]
        here = _below(here, step)
        found = [kind for kind in inner if _fits(kind, here)] or inner
    return [kind for kind in found if _annotations(kind)]


def _inner(kind: object, step: Step) -> list[object]:
    """Return the possible types of the value one step below a value of some type."""
    if get_origin(kind) in (list, tuple):
        return _members(get_args(kind)[0])
    if get_origin(kind) in (dict, Mapping):
        return _members(get_args(kind)[-1])
    return _members(_annotations(kind).get(str(step)))


def _members(annotation: object) -> list[object]:
    """Return the members of a union type, or a single type in a list; `Annotated` is removed."""
    if get_origin(annotation) in (Union, UnionType):
        return [m for a in get_args(annotation) for m in _members(a)]
    return (
        _members(get_args(annotation)[0]) if get_origin(annotation) is Annotated else [annotation]
    )


def _annotations(kind: object) -> dict[str, object]:
    """Return the type of each key of a model or a dataclass; an empty dict for other types."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {f.alias or name: f.annotation for name, f in kind.model_fields.items()}
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return {f.name: hints[f.name] for f in fields(kind)}
    return {}


def _fits(kind: object, here: object) -> bool:
    """Return True if every `Literal` key of the type has one of its allowed values in the file."""
    return all(
        here[key] in get_args(annotation)
        for key, annotation in _annotations(kind).items()
        if get_origin(annotation) is Literal and isinstance(here, dict) and key in here
    )
