"""Declared parameters with name, unit, bounds and prior, and their map to the search space.

A class declares its parameters where its equations are:

    resistance: Array = parameter("ohm", "R", "of a winding", lower=0.1, upper=50.0, start=1.0)

`entries` lists every declared parameter of a tree of such objects, with its path name.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Numbers = Array | np.ndarray
"""JAX array (traced or on a device), or NumPy array, for which JAX compiles nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Declaration:
    """Unit, bounds and prior of a parameter, common to all floors, load set-ups and sessions.

    Attributes:
        unit: unit in the notation of pint, "1" for a dimensionless number.
        symbol: symbol in the equations.
        start: value that is used if nothing else is known [unit].
        lower: lower bound; if there is no upper bound, the search space is the logarithm of
            value - lower.
        upper: upper bound; if there are both bounds, the search space is the log-odds of
            (value - lower) / (upper - lower).
        spread: default std of the prior in the search space: a log-std if the space is logarithmic,
            in [unit] if there are no bounds.
        free: True if the parameter is fitted unless a `Choice` of the user fixes it.
        shares: True if the elements of the array are positive fractions that sum to one.
        deviation: True if the elements of the array sum to zero and represent effects missing in
            the model; their common std is estimated from the data, up to about `spread`.
        closed: True if a fixed value may be the lower bound, such as a friction of 0.
        doc: meaning of the parameter, in one line.
        electric: True if the parameter is estimated from currents and voltages given the motion,
            not from the motion.
        relative: True if the values are ratios to that of the first label, which is fixed unless
            the user frees it.
        of: object to which each element of a vector belongs: a wheel, a drive or an axis.
    """

    unit: str
    symbol: str
    start: float
    lower: float = -math.inf
    upper: float = math.inf
    spread: float = 1.0
    free: bool = True
    shares: bool = False
    deviation: bool = False
    closed: bool = False
    doc: str = ""
    electric: bool = False
    relative: bool = False
    of: str = "wheel"

    @property
    def logarithmic(self) -> bool:
        """True if the search space is logarithmic: there is a lower bound, but no upper one."""
        return math.isinf(self.upper) and not math.isinf(self.lower)

    @property
    def constrained(self) -> bool:
        """True if the sum of the elements is given: n elements then have n - 1 coordinates."""
        return self.shares or self.deviation

    def broken_rule(self, x: np.ndarray, fixed: bool = False) -> str | None:
        """Return the rule that the values `x` break, as a string; None if the values are valid."""
        lowest = fixed and self.closed
        if self.deviation:
            kept, rule = abs(x.sum()) < 1e-6, "numbers that sum to 0"
        elif self.shares:
            kept = (x > 0).all() & (abs(x.sum() - 1) < 1e-6)
            rule = "positive fractions that sum to 1"
        else:
            above = x >= self.lower if lowest else x > self.lower
            kept = (above & (x < self.upper)).all()
            rule = f"inside {'[' if lowest else '('}{self.lower:g}, {self.upper:g}) {self.unit}"
        return None if kept else rule

    def to_search(self, value: Any) -> np.ndarray:
        """Return the search-space vector of an SI value (scalar or array)."""
        x = np.atleast_1d(np.asarray(value, float))
        if self.constrained:
            return np.asarray((np.log(x) if self.shares else x) @ share_basis(len(x)))
        if math.isinf(self.lower) and math.isinf(self.upper):
            return x
        if math.isinf(self.upper):
            return np.log(x - self.lower)
        p = (x - self.lower) / (self.upper - self.lower)
        return np.log(p) - np.log1p(-p)

    def to_si(self, z: Float[Numbers, "*some n"]) -> Float[Numbers, "*some m"]:
        """Return the SI values of one or many search-space vectors.

        JAX compiles nothing if `z` is a NumPy array.
        """
        if self.constrained:
            x: Numbers = z @ share_basis(z.shape[-1] + 1).T
            return _softmax(x) if self.shares else x
        if math.isinf(self.lower) and math.isinf(self.upper):
            return z
        if math.isinf(self.upper):
            return self.lower + (np.exp(z) if isinstance(z, np.ndarray) else jnp.exp(z))
        return self.lower + (self.upper - self.lower) * _sigmoid(z)

    def slope(self, value: Any) -> Any:
        """Return the derivative of SI values with respect to their search coordinates.

        Arguments are SI values of a parameter that is not `constrained`.
        """
        if math.isinf(self.lower) and math.isinf(self.upper):
            return np.ones_like(value)
        if math.isinf(self.upper):
            return value - self.lower
        p = (value - self.lower) / (self.upper - self.lower)
        return (self.upper - self.lower) * p * (1.0 - p)


def _softmax(x: Numbers) -> Numbers:
    if not isinstance(x, np.ndarray):
        return jax.nn.softmax(x)
    part = np.exp(x - x.max(axis=-1, keepdims=True))
    return np.asarray(part / part.sum(axis=-1, keepdims=True))


def _sigmoid(z: Numbers) -> Numbers:
    if not isinstance(z, np.ndarray):
        return jax.nn.sigmoid(z)
    small = np.exp(-np.abs(z))
    return np.where(z >= 0, 1.0, small) / (1.0 + small)


def share_basis(n: int) -> np.ndarray:
    """Return an orthonormal basis (n, n-1) of the vectors whose elements sum to 0 (Helmert)."""
    basis = np.zeros((n, n - 1))
    for k in range(1, n):
        basis[:k, k - 1] = 1.0
        basis[k, k - 1] = -k
        basis[:, k - 1] /= math.sqrt(k * (k + 1))
    return basis


def parameter(
    unit: str, symbol: str, doc: str = "", *, per: str | None = None, **declared: Any
) -> Any:
    """Return a dataclass field for a parameter; `declared` are attributes of its `Declaration`.

    Args:
        per: name of the attribute of the same object, `loads` or `sessions`, that holds one label
            for each index of the array's leading axis; the path then ends in `@label`.
    """
    declaration = Declaration(unit=unit, symbol=symbol, doc=doc, **declared)
    return eqx.field(
        converter=as_numbers,
        metadata={"parameter": declaration, "per": per},
        default_factory=lambda: as_numbers(declaration.start),
    )


known = functools.partial(parameter, free=False)
"""Same as `parameter`, for a parameter that stays fixed unless the user frees it."""


def as_numbers(x: Any) -> Array:
    """Return an array of floating-point numbers, converted without compiling a JAX program."""
    if isinstance(x, jax.core.Tracer) or (isinstance(x, jax.Array) and x.dtype.kind == "f"):
        return x
    return jax.device_put(np.asarray(x, float))


_OF = {"labels": "surface", "loads": "load", "sessions": "session"}
"""Name of the `Entry` attribute that holds a label, keyed by the attribute that lists labels."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A declared parameter of a module tree, scalar or short vector, and where its array is.

    Attributes:
        path: unique name, as in tables, files and error messages.
        quantity: the path without the surface, load set-up or session: `surface.friction`.
        declaration: unit, bounds and prior.
        leaf: attribute names from the root to the array.
        index: index on the array's leading axis, None for the whole array.
        size: number of elements.
        surface, load, session: label to which the parameter belongs, None for a parameter common to
            all labels.
    """

    path: str
    quantity: str
    declaration: Declaration
    leaf: tuple[str, ...]
    index: int | None
    size: int
    surface: str | None = None
    load: str | None = None
    session: str | None = None

    @property
    def part(self) -> str:
        """Attribute of the root that contains the parameter, such as `motor` or `surfaces`."""
        return self.leaf[0]

    def whole(self, tree: Any) -> Any:
        """Return the whole array, in `tree`, that contains this parameter."""
        return functools.reduce(getattr, self.leaf, tree)

    def get(self, tree: Any) -> Any:
        """Return the value in a tree [SI], scalar or vector."""
        whole = self.whole(tree)
        if self.index is None:
            return whole
        # JAX would compile a program for this index; NumPy does not.
        return (whole if isinstance(whole, jax.core.Tracer) else np.asarray(whole))[self.index]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of a vector's elements, empty for a scalar."""
        if self.size == 1:
            return ()
        if self.declaration.of == "axis":
            return ("x", "y")
        return tuple(f"{self.declaration.of} {k + 1}" for k in range(self.size))

    @property
    def coordinates(self) -> int:
        """Number of search-space coordinates that the parameter has if it is free."""
        return self.size - 1 if self.declaration.constrained else self.size


def entries(tree: Any, prefix: str = "", leaf: tuple[str, ...] = ()) -> Iterator[Entry]:
    """Yield every declared parameter of an equinox module and its children, in declared order.

    A child module with a static tuple `labels` has one element per label on the leading axis of its
    arrays; the paths of these elements read `<field>.<label>.<name>`. A key `path` in the metadata
    of a field replaces the field's name in paths (`surface` for `surfaces`).
    """
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        here = (*leaf, field.name)
        if isinstance(value, eqx.Module):
            name = field.metadata.get("path", field.name)
            yield from entries(value, f"{prefix}{name}.", here)
        if (declaration := field.metadata.get("parameter")) is None:
            continue
        shape, quantity = jnp.shape(value), f"{prefix}{field.name}"
        stack = getattr(tree, "labels", ())
        per = "labels" if stack else field.metadata["per"]
        if not per:
            yield Entry(quantity, quantity, declaration, here, None, shape[0] if shape else 1)
            continue
        for k, label in enumerate(getattr(tree, per)):
            path = f"{prefix}{label}.{field.name}" if stack else f"{quantity}@{label}"
            size = 1 if len(shape) == 1 else shape[1]
            yield Entry(path, quantity, declaration, here, k, size, **{_OF[per]: label})
