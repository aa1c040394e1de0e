"""Numbers with a name, a unit, bounds and a prior; the way from SI values to the search space.

A class declares its numbers where its equations are:

    resistance: Array = parameter(unit="ohm", symbol="R", lower=0.1, upper=50.0, start=1.0)

`entries` lists every declared number of a tree of such classes by its path name, `Space` maps the
free ones to a vector without bounds and back.
"""

import dataclasses
import fnmatch
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What a number is, wherever it stands.

    Attributes:
        unit: as pint spells it, "1" without dimension.
        symbol: as the equations write it.
        lower: smallest value; with no `upper` the search space is logarithmic above it.
        upper: largest value; with both the search space is the log-odds of the place between them.
        start: value when nothing else is known [unit].
        spread: std of the prior in the search space when the user gives none: a log-std where the
            space is logarithmic, in [unit] where there are no bounds.
        free: whether it is fitted unless the user says otherwise.
        shares: the numbers of the array are positive and sum to one.
        doc: one line for people.
        electric: it is read from currents and voltages given the motion, not from the motion.
    """

    unit: str
    symbol: str
    lower: float
    upper: float
    start: float
    spread: float
    free: bool
    shares: bool
    doc: str
    electric: bool = False

    def to_search(self, value: Any) -> np.ndarray:
        """Search-space vector of an SI value (scalar or array)."""
        x = np.atleast_1d(np.asarray(value, float))
        if self.shares:
            return np.asarray(np.log(x) @ share_basis(len(x)))
        if math.isinf(self.lower) and math.isinf(self.upper):
            return x
        if math.isinf(self.upper):
            return np.log(x - self.lower)
        p = (x - self.lower) / (self.upper - self.lower)
        return np.log(p) - np.log1p(-p)

    def to_si(self, z: Float[Array, " n"]) -> Float[Array, " m"]:
        """SI values of a search-space vector."""
        if self.shares:
            return jax.nn.softmax(share_basis(z.shape[-1] + 1) @ z)
        if math.isinf(self.lower) and math.isinf(self.upper):
            return z
        if math.isinf(self.upper):
            return self.lower + jnp.exp(z)
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(z)

    def slope(self, value: float) -> float:
        """Derivative d SI / d search at an SI value of one number, shares excepted."""
        if math.isinf(self.lower) and math.isinf(self.upper):
            return 1.0
        if math.isinf(self.upper):
            return value - self.lower
        p = (value - self.lower) / (self.upper - self.lower)
        return (self.upper - self.lower) * p * (1.0 - p)


def share_basis(n: int) -> np.ndarray:
    """Orthonormal basis (n, n-1) of the vectors that sum to zero (Helmert)."""
    basis = np.zeros((n, n - 1))
    for k in range(1, n):
        basis[:k, k - 1] = 1.0
        basis[k, k - 1] = -k
        basis[:, k - 1] /= math.sqrt(k * (k + 1))
    return basis


def parameter(
    *,
    unit: str,
    symbol: str,
    start: float,
    lower: float = -math.inf,
    upper: float = math.inf,
    spread: float = 1.0,
    free: bool = True,
    shares: bool = False,
    per: str | None = None,
    doc: str = "",
    electric: bool = False,
) -> Any:
    """Dataclass field that holds a fitted number; arguments as in `Declaration`.

    Args:
        per: name of the attribute of the same object, `loads` or `sessions`, that holds one label
            per entry of the leading axis; the path then ends in `@label`.
    """
    declaration = Declaration(
        unit, symbol, lower, upper, start, spread, free, shares, doc, electric
    )
    return eqx.field(
        converter=lambda x: (
            jnp.asarray(x, dtype=float) if not isinstance(x, jax.core.Tracer) else x
        ),
        metadata={"parameter": declaration, "per": per},
        default_factory=lambda: jnp.asarray(start, dtype=float),
    )


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

    def get(self, tree: Any) -> Any:
        """Value in a tree [SI], scalar or vector."""
        leaf = _leaf(tree, self.leaf)
        return leaf if self.index is None else leaf[self.index]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of a vector's entries, none for a scalar."""
        if self.size == 1:
            return ()
        if self.size == 2:
            return ("x", "y")
        return tuple(f"wheel {k + 1}" for k in range(self.size))

    @property
    def coordinates(self) -> int:
        """How many search-space coordinates it takes when free."""
        return self.size - 1 if self.declaration.shares else self.size


def entries(tree: Any, prefix: str = "", leaf: tuple[str, ...] = ()) -> Iterator[Entry]:
    """Every declared number below an equinox module, in order of declaration.

    A child module with a static tuple `labels` is a stack along its leading axis: its paths read
    `<field>.<label>.<name>`. A field `path` in the metadata renames a child (`surfaces` ->
    `surface`).
    """
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        here = (*leaf, field.name)
        if (declaration := field.metadata.get("parameter")) is not None:
            yield from _of_field(tree, field, declaration, prefix, here)
        elif isinstance(value, eqx.Module):
            name = field.metadata.get("path", field.name)
            yield from entries(value, f"{prefix}{name}.", here)


def _of_field(
    tree: Any,
    field: dataclasses.Field,
    declaration: Declaration,
    prefix: str,
    leaf: tuple[str, ...],
) -> Iterator[Entry]:
    shape = jnp.shape(getattr(tree, field.name))
    quantity = f"{prefix}{field.name}"
    stack = getattr(tree, "labels", ())
    if not (stack or field.metadata["per"]):
        yield Entry(quantity, quantity, declaration, leaf, None, shape[0] if shape else 1)
        return
    per = "labels" if stack else field.metadata["per"]
    for k, label in enumerate(getattr(tree, per)):
        path = f"{prefix}{label}.{field.name}" if stack else f"{quantity}@{label}"
        size = 1 if len(shape) == 1 else shape[1]
        yield Entry(path, quantity, declaration, leaf, k, size, **{_OF[per]: label})


_OF = {"labels": "surface", "loads": "load", "sessions": "session"}
"""What the labels under a name are of."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """What the user wants of the paths that match a pattern.

    Attributes:
        pattern: path, `*` and `?` allowed: `surface.*.creep`.
        start: value to begin with [SI]; a number that is fixed stays so, at this value.
        fixed: value it keeps [SI]; None leaves it free.
        free: True or False to say it without a value.
        prior_mean: centre of the prior [SI].
        prior_std: std of the prior, in SI around its centre, which without `prior_mean` is the
            declared start.
    """

    pattern: str
    start: Any = None
    fixed: Any = None
    free: bool | None = None
    prior_mean: Any = None
    prior_std: Any = None


class Space(eqx.Module):
    """The free numbers of a tree as one vector without bounds, Gaussian prior included.

    Goes through compiled functions as an argument: spaces of the same parameters share them.

    Attributes:
        template: the tree; what is fixed keeps its value here.
        start, prior_mean, prior_std: in the search space.
        all: every declared number of the tree.
        free: those that are fitted.
    """

    template: Any
    start: Float[np.ndarray, " free"]
    prior_mean: Float[np.ndarray, " free"]
    prior_std: Float[np.ndarray, " free"]
    all: tuple[Entry, ...] = eqx.field(static=True)
    free: tuple[Entry, ...] = eqx.field(static=True)

    def __init__(self, tree: Any, choices: Sequence[Choice] = ()):
        """Space of a module with declared numbers.

        Args:
            tree: the module.
            choices: later ones win.

        Raises:
            ValueError: a pattern matches no path, or a value lies outside its bounds.
        """
        self.all = tuple(entries(tree))
        unknown = [
            c.pattern
            for c in choices
            if not any(fnmatch.fnmatchcase(e.path, c.pattern) for e in self.all)
        ]
        if unknown:
            paths = ", ".join(e.path for e in self.all)
            raise ValueError(f"no parameter '{unknown[0]}'; there are: {paths}")
        free, starts, means, spreads = [], [], [], []
        for entry in self.all:
            picked = [c for c in choices if fnmatch.fnmatchcase(entry.path, c.pattern)]
            value, mean, spread, is_free = _settle(entry, entry.get(tree), picked)
            tree = _put(tree, entry, value)
            if is_free:
                free.append(entry)
                starts.append(entry.declaration.to_search(value))
                means.append(mean)
                spreads.append(spread)
        self.template = tree
        self.free = tuple(free)
        self.start, self.prior_mean, self.prior_std = (
            np.concatenate([np.zeros(0), *parts]) for parts in (starts, means, spreads)
        )

    @property
    def place(self) -> dict[str, slice]:
        """Where the coordinates of every free number are, by path."""
        ends = np.cumsum([0, *(e.coordinates for e in self.free)]).tolist()
        return {e.path: slice(a, b) for e, a, b in zip(self.free, ends, ends[1:], strict=False)}

    def where(self, wanted: Callable[[Entry], bool]) -> Bool[np.ndarray, " free"]:
        """Coordinates of the free numbers that are wanted."""
        count = [e.coordinates for e in self.free]
        return np.repeat(np.array([wanted(e) for e in self.free], bool), count)

    @property
    def electric(self) -> Bool[np.ndarray, " free"]:
        """Coordinates that are read from currents and voltages given the motion."""
        return self.where(lambda e: e.declaration.electric)

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return sum(e.coordinates for e in self.free)

    @property
    def names(self) -> list[str]:
        """One name per coordinate: the path, numbered where it takes several."""
        return [
            e.path if e.coordinates == 1 else f"{e.path}[{k + 1}]"
            for e in self.free
            for k in range(e.coordinates)
        ]

    def tree(self, z: Float[Array, " free"] | Float[np.ndarray, " free"]) -> Any:
        """Tree of SI values at a search-space vector; jit-able."""
        z = jnp.asarray(z)
        changed: dict[tuple[str, ...], Any] = {}
        place = self.place
        for entry in self.free:
            leaf = changed.get(entry.leaf)
            if leaf is None:
                leaf = _leaf(self.template, entry.leaf)
            value = entry.declaration.to_si(z[place[entry.path]])
            if entry.size == 1 and value.shape[0] == 1:
                value = value[0]
            changed[entry.leaf] = value if entry.index is None else leaf.at[entry.index].set(value)
        return _put_leaves(self.template, changed)

    def vector(self, tree: Any) -> np.ndarray:
        """Search-space vector of a tree's free numbers."""
        parts = [e.declaration.to_search(np.asarray(e.get(tree))) for e in self.free]
        return np.concatenate(parts) if parts else np.zeros(0)


def _settle(entry: Entry, value: Any, picked: list[Choice]) -> tuple[Any, Any, Any, bool]:
    """Value, prior mean and std in the search space, and whether it is free."""
    d = entry.declaration
    usual = np.full(entry.size, 1 / entry.size if d.shares else d.start)
    is_free, mean_si, std_si = d.free, None, None
    for c in picked:
        if c.fixed is not None:
            value, is_free = _inside(entry, c.fixed), False
        if c.start is not None:
            value = _inside(entry, c.start)
        if c.prior_mean is not None or c.prior_std is not None:
            mean = usual if c.prior_mean is None else c.prior_mean
            mean_si, std_si = _inside(entry, mean), _spread(entry, c.prior_std)
            value = value if c.prior_mean is None or c.start is not None else mean_si
            is_free = True
        if c.free is not None:
            is_free = c.free
    value = _inside(entry, value)
    mean = d.to_search(usual if mean_si is None else mean_si)
    if std_si is None:
        spread = np.full(entry.coordinates, d.spread)
    elif d.shares:
        share = np.asarray(mean_si, float)
        slopes = (np.diag(share) - np.outer(share, share)) @ share_basis(entry.size)
        spread = np.full(
            entry.coordinates, np.mean(std_si) / np.sqrt((slopes**2).sum(axis=1).mean())
        )
    else:
        slope = [d.slope(float(v)) for v in np.atleast_1d(np.asarray(mean_si, float))]
        spread = np.broadcast_to(np.asarray(std_si, float), (entry.size,)) / np.asarray(slope)
    return value, mean, spread, is_free


def _spread(entry: Entry, std: Any) -> Any:
    """Std of a prior, checked; None where only its centre was given."""
    if std is None:
        return None
    x = np.asarray(std, float)
    if x.size not in (1, entry.size) or not (np.isfinite(x) & (x > 0)).all():
        raise ValueError(f"{entry.path}: prior std {std}; expected 1 or {entry.size} above zero")
    return x.ravel() if x.size > 1 else float(x.reshape(()))


def _inside(entry: Entry, value: Any) -> Any:
    """Value as an array, checked."""
    x = np.asarray(value, float)
    d = entry.declaration
    if x.size == 1 and entry.size > 1:
        x = np.full(entry.size, float(x.reshape(())))
    if x.size != entry.size:
        raise ValueError(f"{entry.path} takes {entry.size} numbers, got {x.size}")
    outside = ~((x > d.lower) & (x < d.upper))
    if d.shares:
        outside = ~((x > 0) & (abs(x.sum() - 1) < 1e-6))
    if outside.any():
        rule = (
            "positive shares that sum to 1"
            if d.shares
            else f"inside ({d.lower:g}, {d.upper:g}) {d.unit}"
        )
        raise ValueError(f"{entry.path} = {value}: expected {rule}")
    return x.reshape(()) if entry.size == 1 else x


def _leaf(tree: Any, names: tuple[str, ...]) -> Any:
    """What stands at the end of a chain of attribute names."""
    return functools.reduce(getattr, names, tree)


def _put(tree: Any, entry: Entry, value: Any) -> Any:
    whole = _leaf(tree, entry.leaf)
    new = jnp.asarray(value, dtype=whole.dtype)
    new = new.reshape(whole.shape) if entry.index is None else whole.at[entry.index].set(new)
    return _put_leaves(tree, {entry.leaf: new})


def _put_leaves(tree: Any, changed: dict[tuple[str, ...], Any]) -> Any:
    if not changed:
        return tree
    keys = list(changed)

    def where(t: Any) -> list[Any]:
        return [_leaf(t, key) for key in keys]

    return eqx.tree_at(where, tree, [changed[k] for k in keys])
