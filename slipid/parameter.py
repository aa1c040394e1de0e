"""Numbers with a name, a unit, bounds and a prior; the way from SI values to the search space.

A class declares its numbers where its equations are:

    resistance: Array = parameter("ohm", "R", "of a winding", lower=0.1, upper=50.0, start=1.0)

`entries` lists every declared number of a tree of such classes by its path name.
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
"""Numbers that are being traced or lie on a device, or numpy's, for which nothing is compiled."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Declaration:
    """What a number is, wherever it stands.

    Attributes:
        unit: as pint spells it, "1" without dimension.
        symbol: as the equations write it.
        start: value when nothing else is known [unit].
        lower: smallest value; with no `upper` the search space is logarithmic above it.
        upper: largest value; with both the search space is the log-odds of the place between them.
        spread: std of the prior in the search space when the user gives none: a log-std where the
            space is logarithmic, in [unit] where there are no bounds.
        free: whether it is fitted unless the user says otherwise.
        shares: the numbers of the array are positive and sum to one.
        deviation: the numbers of the array sum to zero and stand for what a model lacks; the spread
            of all of them together is found from the data, up to about `spread`.
        doc: one line for people.
        electric: it is read from currents and voltages given the motion, not from the motion.
        of: what the numbers of a vector are of, one each: a wheel, a drive or an axis.
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
    doc: str = ""
    electric: bool = False
    of: str = "wheel"

    @property
    def logarithmic(self) -> bool:
        """Whether the search space is that of a logarithm."""
        return math.isinf(self.upper) and not math.isinf(self.lower)

    @property
    def constrained(self) -> bool:
        """Whether its numbers have one coordinate less than there are of them."""
        return self.shares or self.deviation

    def to_search(self, value: Any) -> np.ndarray:
        """Search-space vector of an SI value (scalar or array)."""
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
        """SI values of a search-space vector, or of many; numpy's for numpy's, uncompiled."""
        if self.constrained:
            x: Numbers = z @ share_basis(z.shape[-1] + 1).T
            return _softmax(x) if self.shares else x
        if math.isinf(self.lower) and math.isinf(self.upper):
            return z
        if math.isinf(self.upper):
            return self.lower + (np.exp(z) if isinstance(z, np.ndarray) else jnp.exp(z))
        return self.lower + (self.upper - self.lower) * _sigmoid(z)

    def slope(self, value: Any) -> Any:
        """Derivative d SI / d search at SI values, of numbers that are not tied."""
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
    """Orthonormal basis (n, n-1) of the vectors that sum to zero (Helmert)."""
    basis = np.zeros((n, n - 1))
    for k in range(1, n):
        basis[:k, k - 1] = 1.0
        basis[k, k - 1] = -k
        basis[:, k - 1] /= math.sqrt(k * (k + 1))
    return basis


def parameter(
    unit: str, symbol: str, doc: str = "", *, per: str | None = None, **declared: Any
) -> Any:
    """Dataclass field that holds a fitted number, declared by the attributes of `Declaration`.

    Args:
        per: name of the attribute of the same object, `loads` or `sessions`, that holds one label
            per entry of the leading axis; the path then ends in `@label`.
    """
    declaration = Declaration(unit=unit, symbol=symbol, doc=doc, **declared)
    return eqx.field(
        converter=lambda x: (
            jnp.asarray(x, dtype=float) if not isinstance(x, jax.core.Tracer) else x
        ),
        metadata={"parameter": declaration, "per": per},
        default_factory=lambda: jnp.asarray(declaration.start, dtype=float),
    )


_OF = {"labels": "surface", "loads": "load", "sessions": "session"}
"""What the labels under a name are of."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """One declared number (or short vector) of a tree.

    Attributes:
        path: its one name, as in tables, files and errors.
        quantity: the same without the floor, load set-up or session it is of: `surface.friction`.
        declaration: unit, bounds, prior.
        leaf: attribute names from the root to the array.
        index: place on the array's leading axis, None for the whole array.
        size: how many numbers.
        surface, load, session: that it is of, None for a number that all of them share.
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
        """Attribute of the whole it belongs to: `motor`, `surfaces`, `camera`."""
        return self.leaf[0]

    def whole(self, tree: Any) -> Any:
        """Array of a tree that it stands in."""
        return functools.reduce(getattr, self.leaf, tree)

    def get(self, tree: Any) -> Any:
        """Value in a tree [SI], scalar or vector."""
        whole = self.whole(tree)
        if self.index is None:
            return whole
        # numpy indexes without compiling anything
        return (whole if isinstance(whole, jax.core.Tracer) else np.asarray(whole))[self.index]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of a vector's entries, none for a scalar."""
        if self.size == 1:
            return ()
        if self.declaration.of == "axis":
            return ("x", "y")
        return tuple(f"{self.declaration.of} {k + 1}" for k in range(self.size))

    @property
    def coordinates(self) -> int:
        """How many search-space coordinates it takes when free."""
        return self.size - 1 if self.declaration.constrained else self.size


def entries(tree: Any, prefix: str = "", leaf: tuple[str, ...] = ()) -> Iterator[Entry]:
    """Every declared number below an equinox module, in order of declaration.

    A child module with a static tuple `labels` is a stack along its leading axis: its paths read
    `<field>.<label>.<name>`. A field `path` in the metadata renames a child (`surfaces` ->
    `surface`).
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
