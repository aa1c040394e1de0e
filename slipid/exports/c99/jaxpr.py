"""Access to traced functions of JAX in the same way for all supported versions of JAX.

Only this module depends on where a version of JAX stores a primitive's parameters, the functions
that a primitive calls, and the line of Python code from which a primitive was traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import jax
from jax.extend.core import Jaxpr, JaxprEqn

from slipid.support.errors import DataError

KNOWN = ">=0.10,<0.13"
"""Supported versions of JAX."""


class Params(dict[str, Any]):
    """Parameters of a primitive, keyed by their names in JAX.

    Raises:
        DataError: in this version of JAX the primitive has no parameter with a requested name.
    """

    def __init__(self, equation: JaxprEqn):
        super().__init__(equation.params)
        self._primitive = equation.primitive.name

    def __missing__(self, name: str) -> NoReturn:
        raise unknown(f"'{self._primitive}'")


@dataclass(frozen=True)
class Traced:
    """A traced function.

    Attributes:
        jaxpr: equations, arguments and results of the function, in JAX's form.
        constants: values of the constant variables of the jaxpr, in their order.
    """

    jaxpr: Jaxpr
    constants: Sequence[object]

    @classmethod
    def of(cls, written: object) -> Traced:
        """Return a traced function from JAX's own representation of it.

        JAX 0.10 has two classes that represent functions, later versions have one.

        Raises:
            DataError: this version of JAX represents functions in an unsupported way.
        """
        jaxpr, constants = getattr(written, "jaxpr", written), getattr(written, "consts", ())
        if not isinstance(jaxpr, Jaxpr) or len(jaxpr.constvars) != len(constants):
            raise unknown("functions")
        return cls(jaxpr, tuple(constants))


@dataclass(frozen=True)
class ScanParameters:
    """Parameters of a scan, which applies a function repeatedly to its own results.

    Attributes:
        body: the function.
        turns: number of times that the function is applied.
        constants: number of leading arguments that are the same in every iteration.
        carried: number of further arguments, which are the results of the previous iteration.
    """

    body: Traced
    turns: int
    constants: int
    carried: int

    @classmethod
    def of(cls, params: Params) -> ScanParameters:
        """Read the parameters in the form of JAX 0.10 (two counts) or of later versions (a tree).

        Raises:
            DataError: this version of JAX represents the parameters in an unsupported way.
        """
        if "num_carry" in params:
            constants, carried = params["num_consts"], params["num_carry"]
        else:
            try:
                constants, carried, _ = map(len, params["ft_in"].unpack())
            except (AttributeError, TypeError, ValueError) as error:
                raise unknown("'scan'") from error
        return cls(Traced.of(params["jaxpr"]), params["length"], constants, carried)


def called(params: Params) -> Traced:
    """Return the function that a primitive calls."""
    return Traced.of(params.get("jaxpr", params.get("call_jaxpr")))


def branches(params: Params) -> list[Traced]:
    """Return the functions of the branches of a `cond`."""
    return [Traced.of(branch) for branch in params["branches"]]


def source_line(equation: JaxprEqn) -> str:
    """Return file and line of the innermost slipid code outside `exports` that made an equation.

    The result is empty if there is no such code.
    """
    traceback = equation.source_info.traceback
    for frame in traceback.frames if traceback is not None else ():
        parts = Path(frame.file_name).parts
        inner = parts[len(parts) - parts[::-1].index("slipid") :] if "slipid" in parts else ()
        if inner and inner[0] != "exports":
            return f"slipid/{'/'.join(inner)}:{frame.line_num}"
    return ""


def unknown(what: str) -> DataError:
    """Return the error for a part of JAX that the installed version represents differently."""
    return DataError(
        f"jax {jax.__version__} represents {what} in a way that this version of slipid does not "
        f"support; expected a supported version: pip install 'jax{KNOWN}'"
    )
