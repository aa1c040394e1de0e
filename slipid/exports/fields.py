"""Structs of the generated code, with a field for every array of a state, an input or an output.

A field's comment is the description of the attribute in the docstring of the Python class; it
contains the unit in brackets.
"""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass, fields, is_dataclass
from math import prod
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from slipid.robot.closed_loop import ControlLoop
from slipid.robot.interface import Measurement, Readings

Kind = Literal["real", "int", "bool"]
DTYPES: dict[Kind, type] = {"real": np.float64, "int": np.int64, "bool": np.bool_}
UNIT = re.compile(r"\[[^\]]+\]")
NO_UNIT = "[1]"
"""Unit that is added to a field's description if the description has no unit."""


@dataclass(frozen=True)
class Field:
    """An array of numbers that is a member of a struct; its attributes are keys in step.json.

    Attributes:
        name: name in C.
        numbers: kind of the array's numbers.
        shape: shape of the array; () for a single number.
        about: meaning and unit of the field.
    """

    name: str
    numbers: Kind
    shape: tuple[int, ...]
    about: str

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)


@dataclass(frozen=True)
class Struct:
    """A struct of C.

    Attributes:
        name: name of the type, without the prefix `slipid_`.
        fields: fields, in the order of the leaves of `example`.
        example: tree (as in `jax.tree`) whose arrays have the shapes of the fields.
    """

    name: str
    fields: tuple[Field, ...]
    example: object


def kind_of(dtype: np.dtype) -> Kind:
    """Return the kind of number of a data type of jax or numpy."""
    if dtype == np.bool_:
        return "bool"
    return "int" if np.issubdtype(dtype, np.integer) else "real"


def attribute_docs(kind: type) -> dict[str, str]:
    """Return the description of every attribute in a class's docstring, keyed by its name."""
    _, _, text = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    found = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", text, re.MULTILINE)
    return {name: " ".join(about.split()).rstrip(";.") for name, about in found}


def structs_of(loop: ControlLoop[eqx.Module]) -> tuple[Struct, Struct, Struct, Struct]:
    """Return the structs of a control loop: estimator, controller, reading, and estimate.

    The first two are the states of estimator and controller; reading and estimate are the input and
    the output of the estimator's step.
    """
    begin, nothing = loop.init(), Readings.nothing(loop.controller.robot.drives)
    estimate = loop.estimator.step(begin.estimator, nothing, jnp.zeros(()))[1]
    return (
        Struct("estimator", fields_of(begin.estimator), begin.estimator),
        Struct("controller", fields_of(begin.controller), begin.controller),
        Struct("reading", fields_of(nothing, Measurement), nothing),
        Struct("estimate", fields_of(estimate), estimate),
    )


def fields_of(
    tree: object, documented: type | None = None, prefix: str = "", above: str = ""
) -> tuple[Field, ...]:
    """Return a field for every array in a tree of modules with documented attributes.

    Attributes that are None, as of robots that steer in others, have no field.

    Args:
        tree: an array, or a module that contains arrays and further modules.
        documented: class whose docstring describes the attributes; by default the tree's class.
        prefix: beginning of the fields' names.
        above: description of the attribute that contains the tree, used for leaves without a
            description.
    """
    if is_dataclass(tree) and not isinstance(tree, type):
        docs = attribute_docs(documented or type(tree))
        parts: list[Field] = []
        for field in fields(tree):
            if not field.metadata.get("static", False):
                name = f"{prefix}_{field.name}" if prefix else field.name
                about = docs.get(field.name, above)
                parts += fields_of(getattr(tree, field.name), None, name, about)
        return tuple(parts)
    if tree is None:
        return ()
    array = jnp.asarray(tree)
    about = above if UNIT.search(above) else f"{above} {NO_UNIT}".strip()
    return (Field(prefix, kind_of(array.dtype), tuple(array.shape), about),)
