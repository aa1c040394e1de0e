"""Structs of the generated code, with a field for every array of a state, an input or an output.

Their comments are those of the Python classes, whose docstrings describe each attribute with its
unit in brackets.
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
"""Unit of a field without one."""


@dataclass(frozen=True)
class Field:
    """A member of a struct.

    Attributes:
        name: name in C.
        kind: kind of its numbers.
        shape: shape of the array; () for a single number.
        comment: meaning with its unit.
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
        name: name of the type.
        about: one sentence.
        fields: fields in the order of the tree's leaves.
    """

    name: str
    about: str
    fields: tuple[Field, ...]

    @classmethod
    def of(cls, name: str, about: str, tree: object, documented: type | None = None) -> Struct:
        """Return the struct of a tree of arrays, or of modules with documented attributes.

        `documented` is the class whose docstring describes the attributes, if not the tree's own.
        """
        return cls(name, about, tuple(_fields(tree, "", "", documented)))


def kind_of(dtype: np.dtype) -> Kind:
    """Return the kind of the numbers of a type of jax or numpy."""
    if dtype == np.bool_:
        return "bool"
    return "int" if np.issubdtype(dtype, np.integer) else "real"


def attribute_docs(kind: type) -> dict[str, str]:
    """Return the description of every attribute in a class's docstring.

    Several attributes may share a sentence, `place, turn: of its ... [m], [rad].`, or a line,
    separated by semicolons.
    """
    names = [field.name for field in fields(kind)]
    text = inspect.getdoc(kind) or ""
    _, _, rest = text.partition("Attributes:")
    flat = " ".join(rest.split())
    either = "|".join(re.escape(name) for name in names)
    head = re.compile(rf"(?:^|(?<=[.;] )|(?<=[.;]))((?:(?:{either})(?:, )?)+): ")
    heads = list(head.finditer(flat))
    ends = [*(match.start() for match in heads[1:]), len(flat)][: len(heads)]
    return {
        name: flat[match.end() : end].strip().rstrip(";.")
        for match, end in zip(heads, ends, strict=True)
        for name in match.group(1).split(", ")
    }


def _fields(tree: object, prefix: str, above: str, by: type | None = None) -> list[Field]:
    """Return the fields of a tree, whose names begin with a prefix."""
    if is_dataclass(tree) and not isinstance(tree, type):
        docs = attribute_docs(by or type(tree))
        parts = []
        for field in fields(tree):
            if not field.metadata.get("static", False):
                name = f"{prefix}_{field.name}" if prefix else field.name
                parts += _fields(getattr(tree, field.name), name, docs.get(field.name, above))
        return parts
    array = jnp.asarray(tree)
    comment = above if UNIT.search(above) else f"{above} {ONE}".strip()
    return [Field(prefix, kind_of(array.dtype), tuple(array.shape), comment)]
