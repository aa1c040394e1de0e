"""Structs of the generated code, with a field for every array of a state, an input or an output.

The comment of a field is the description of the attribute in the Python class's docstring, which
contains the unit in brackets.
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
"""Unit written for a field whose description has none."""


@dataclass(frozen=True)
class Field:
    """A member of a struct.

    Attributes:
        name: name in C.
        kind: kind of its numbers.
        shape: shape of the array; () for a single number.
        comment: meaning and unit of the field.
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
        about: comment of the struct, one sentence.
        fields: fields in the order of the tree's leaves.
    """

    name: str
    about: str
    fields: tuple[Field, ...]

    @classmethod
    def of(cls, name: str, about: str, tree: object, documented: type | None = None) -> Struct:
        """Return the struct for a tree of arrays or of modules with documented attributes.

        `documented` is the class whose docstring describes the attributes; by default the class of
        the tree.
        """
        return cls(name, about, tuple(_fields(tree, "", "", documented)))


def kind_of(dtype: np.dtype) -> Kind:
    """Return the kind of number for a data type of jax or numpy."""
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
    """Return the fields of a tree.

    Args:
        tree: arrays, in modules that may contain further modules.
        prefix: beginning of the fields' names.
        above: description of the attribute that holds the tree, used where there is no other.
        by: class whose docstring describes the attributes; by default that of the tree.
    """
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
