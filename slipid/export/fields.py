"""Structs of the generated code: a field for every array of a step's state, input and output.

Their comments are those of the Python classes, whose docstrings say what each attribute is, with
its unit in brackets.
"""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass, fields, is_dataclass
from math import prod
from typing import Literal

import jax.numpy as jnp
import numpy as np

Kind = Literal["real", "int", "bool"]
DTYPES: dict[Kind, type] = {"real": np.float64, "int": np.int64, "bool": np.bool_}
UNIT = re.compile(r"\[[^\]]+\]")
ONE = "[1]"
"""Unit of what has none."""


@dataclass(frozen=True)
class Field:
    """A member of a struct.

    Attributes:
        name: in C; kind: of its numbers; shape: () where it is a single one.
        comment: what it is, with its unit.
    """

    name: str
    kind: Kind
    shape: tuple[int, ...]
    comment: str

    @property
    def size(self) -> int:
        """Count of its numbers."""
        return prod(self.shape)


@dataclass(frozen=True)
class Struct:
    """A struct of C.

    Attributes:
        name: of the type; about: one sentence; fields: in the order of the tree's leaves.
    """

    name: str
    about: str
    fields: tuple[Field, ...]

    @classmethod
    def of(cls, name: str, about: str, tree: object, said: type | None = None) -> Struct:
        """For a tree of arrays, of modules with documented attributes, or documented by a class."""
        return cls(name, about, tuple(_fields(tree, "", "", said)))


def kind_of(dtype: np.dtype) -> Kind:
    """Kind of the numbers of a type of jax or numpy."""
    if dtype == np.bool_:
        return "bool"
    return "int" if np.issubdtype(dtype, np.integer) else "real"


def attribute_docs(kind: type) -> dict[str, str]:
    """What a class's docstring says of every attribute.

    Several attributes may share a sentence, `place, turn: of its ... [m], [rad].`, or a line, apart
    by semicolons.
    """
    names = [field.name for field in fields(kind)]
    text = inspect.getdoc(kind) or ""
    _, _, rest = text.partition("Attributes:")
    flat = " ".join(rest.split())
    either = "|".join(re.escape(name) for name in names)
    head = re.compile(rf"(?:^|(?<=[.;] )|(?<=[.;]))((?:(?:{either})(?:, )?)+): ")
    found = list(head.finditer(flat))
    ends = [*(match.start() for match in found[1:]), len(flat)][: len(found)]
    out = {}
    for match, end in zip(found, ends, strict=True):
        said = flat[match.end() : end].strip().rstrip(";.")
        for name in match.group(1).split(", "):
            out[name] = said
    return out


def _fields(tree: object, prefix: str, above: str, by: type | None = None) -> list[Field]:
    if is_dataclass(tree) and not isinstance(tree, type):
        said = attribute_docs(by or type(tree))
        parts = []
        for field in fields(tree):
            if not field.metadata.get("static", False):
                name = f"{prefix}_{field.name}" if prefix else field.name
                parts += _fields(getattr(tree, field.name), name, said.get(field.name, above))
        return parts
    array = jnp.asarray(tree)
    comment = above if UNIT.search(above) else f"{above} {ONE}".strip()
    return [Field(prefix, kind_of(array.dtype), tuple(array.shape), comment)]
