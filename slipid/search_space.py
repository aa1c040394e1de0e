"""Search space of a fit: its free parameters as one vector without bounds, and the user's choices.

A parameter of a module tree is a scalar or a small vector, declared with `slipid.parameter`.
"""

import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.parameter import Entry, entries, share_basis

HELD = 1e-4
"""Largest prior std, in the search space, at which a coordinate counts as fixed by its prior."""


@dataclass(frozen=True)
class Choice:
    """The user's choice for all parameters whose path matches a pattern.

    Attributes:
        pattern: path, with `*` and `?` as wildcards: `surface.*.creep`.
        start: start value [SI], which is also the value of a parameter that is not fitted.
        fixed: value at which the parameter is fixed [SI]; None does not fix it.
        free: True to fit the parameter, False to keep it at its start value, None for the default.
        prior_mean: mean of the prior [SI]; a parameter with a prior is fitted.
        prior_std: std of the prior [SI], one value or one per element; without `prior_mean`, the
            prior is centred on the declared start value, or on equal fractions (`shares`).
    """

    pattern: str
    start: Any = None
    fixed: Any = None
    free: bool | None = None
    prior_mean: Any = None
    prior_std: Any = None


class Space(eqx.Module):
    """The free parameters of a tree as one vector without bounds, with their Gaussian prior.

    A space is passed to compiled functions as an argument, so that spaces with the same parameters
    share these functions.

    Attributes:
        template: tree with the values of fixed parameters and the start values of free ones.
        start, prior_mean, prior_std: start vector, and mean and std of the prior, in the search
            space.
        pooled: mask of the coordinates of deviations (`Declaration.deviation`) whose prior std is
            estimated from the data because the user gave none.
        all: every declared parameter of the tree.
        free: the parameters that are fitted.
    """

    template: Any
    start: Float[np.ndarray, " free"]
    prior_mean: Float[np.ndarray, " free"]
    prior_std: Float[np.ndarray, " free"]
    pooled: Bool[np.ndarray, " free"]
    all: tuple[Entry, ...] = eqx.field(static=True)
    free: tuple[Entry, ...] = eqx.field(static=True)

    def __init__(self, tree: Any, choices: Sequence[Choice] = ()):
        """Build the space of a module tree; later choices override earlier ones.

        Raises:
            ValueError: a pattern matches no path, a value breaks the rules of its declaration, or
                a prior std is not positive.
        """
        self.all = tuple(entries(tree))
        for c in choices:
            if not any(fnmatch.fnmatchcase(e.path, c.pattern) for e in self.all):
                paths = ", ".join(e.path for e in self.all)
                raise ValueError(f"no parameter '{c.pattern}'; there are: {paths}")
        values: dict[Entry, Any] = {}
        free, starts, means, spreads, pooled = [], [], [], [], []
        for entry in self.all:
            picked = [c for c in choices if fnmatch.fnmatchcase(entry.path, c.pattern)]
            value, mean, spread, is_free = _resolved(entry, entry.get(tree), picked)
            values[entry] = value
            if is_free:
                free.append(entry)
                starts.append(entry.declaration.to_search(value))
                means.append(mean)
                spreads.append(spread)
                found = entry.declaration.deviation and all(c.prior_std is None for c in picked)
                pooled.append(np.full(entry.coordinates, found))
        self.template = with_values(tree, values)
        self.free = tuple(free)
        self.start, self.prior_mean, self.prior_std = (
            np.concatenate([np.zeros(0), *parts]) for parts in (starts, means, spreads)
        )
        self.pooled = np.concatenate([np.zeros(0, bool), *pooled])

    def with_pooled(self, std: float) -> "Space":
        """Return the same space, but with the prior std `std` for the pooled coordinates."""
        prior_std = np.where(self.pooled, std, self.prior_std)
        return eqx.tree_at(lambda space: space.prior_std, self, prior_std)

    @property
    def slices(self) -> dict[str, slice]:
        """Slice of the search vector that holds each free parameter, keyed by its path."""
        ends = np.cumsum([0, *(e.coordinates for e in self.free)]).tolist()
        return {e.path: slice(a, b) for e, a, b in zip(self.free, ends, ends[1:], strict=False)}

    def where(self, wanted: Callable[[Entry], bool]) -> Bool[np.ndarray, " free"]:
        """Return a mask of the coordinates for whose parameter `wanted` is true."""
        count = [e.coordinates for e in self.free]
        return np.repeat(np.array([wanted(e) for e in self.free], bool), count)

    @property
    def held(self) -> Bool[np.ndarray, " free"]:
        """Mask of the coordinates that are held at the prior mean by a std of at most `HELD`."""
        return self.prior_std <= HELD

    @property
    def electric(self) -> Bool[np.ndarray, " free"]:
        """Mask of the coordinates that currents and voltages determine, given the motion."""
        return self.where(lambda e: e.declaration.electric)

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return sum(e.coordinates for e in self.free)

    @property
    def names(self) -> list[str]:
        """One name per coordinate: its parameter's path, with an index if there are several."""
        return [
            e.path if e.coordinates == 1 else f"{e.path}[{k + 1}]"
            for e in self.free
            for k in range(e.coordinates)
        ]

    def tree(self, z: Float[Array, " free"] | Float[np.ndarray, " free"]) -> Any:
        """Return the tree of SI values at a search-space vector; `z` may be traced."""
        z, slices = z if isinstance(z, jax.core.Tracer) else np.asarray(z, float), self.slices
        return with_values(
            self.template, {e: e.declaration.to_si(z[slices[e.path]]) for e in self.free}
        )

    def vector(self, tree: Any) -> np.ndarray:
        """Return the search-space vector of a tree's free parameters."""
        parts = [e.declaration.to_search(np.asarray(e.get(tree))) for e in self.free]
        return np.concatenate([np.zeros(0), *parts])


def with_values(tree: Any, values: Mapping[Entry, Any]) -> Any:
    """Return the tree with new values [SI] at some entries.

    Values that are not traced are handled with NumPy, so that JAX compiles nothing for them.
    """
    changed: dict[tuple[str, ...], tuple[Entry, Any]] = {}
    for entry, value in values.items():
        whole = changed[entry.leaf][1] if entry.leaf in changed else entry.whole(tree)
        changed[entry.leaf] = entry, _replaced(whole, entry.index, value)
    if not changed:
        return tree
    places, arrays = zip(*changed.values(), strict=True)
    put = [a if isinstance(a, jax.core.Tracer) else jax.device_put(a) for a in arrays]
    return eqx.tree_at(lambda t: [e.whole(t) for e in places], tree, put)


def _replaced(whole: Any, index: int | None, value: Any) -> Any:
    """Return an array in which `value` replaces row `index`, or all of it if `index` is None."""
    shape = whole.shape if index is None else whole.shape[1:]
    if isinstance(whole, jax.core.Tracer) or isinstance(value, jax.core.Tracer):
        traced = jnp.asarray(value, dtype=whole.dtype).reshape(shape)
        return traced if index is None else jnp.asarray(whole).at[index].set(traced)
    new = np.asarray(value, dtype=whole.dtype).reshape(shape)
    if index is None:
        return new
    out = np.array(whole)
    out[index] = new
    return out


def _resolved(entry: Entry, value: Any, picked: list[Choice]) -> tuple[Any, Any, Any, bool]:
    """Return the value [SI] of an entry, its prior mean and prior std, and whether it is free.

    Mean and std are in the search space. `picked` are the choices that match the entry.
    """
    d = entry.declaration
    usual = np.full(entry.size, 1 / entry.size if d.shares else d.start)
    is_free, mean_si, std_si = d.free and not (d.relative and entry.index == 0), None, None
    for c in picked:
        if c.fixed is not None:
            value, is_free = _checked_value(entry, c.fixed, fixed=True), False
        if c.start is not None:
            value = _checked_value(entry, c.start)
        if c.prior_mean is not None or c.prior_std is not None:
            mean_si = _checked_value(entry, usual if c.prior_mean is None else c.prior_mean)
            std_si = _checked_std(entry, c.prior_std)
            value = value if c.prior_mean is None or c.start is not None else mean_si
            is_free = True
        if c.free is not None:
            is_free = c.free
    value = _checked_value(entry, value, fixed=not is_free)
    mean = d.to_search(usual if mean_si is None else mean_si)
    if std_si is None:
        spread = np.full(entry.coordinates, d.spread)
    elif d.shares:
        share = np.asarray(mean_si, float)
        slopes = (np.diag(share) - np.outer(share, share)) @ share_basis(entry.size)
        spread = np.full(
            entry.coordinates, np.mean(std_si) / np.sqrt((slopes**2).sum(axis=1).mean())
        )
    elif d.deviation:
        spread = np.full(entry.coordinates, np.mean(std_si))
    else:
        spread = std_si / d.slope(np.atleast_1d(np.asarray(mean_si, float)))
    return value, mean, spread, is_free


def _checked_std(entry: Entry, std: Any) -> np.ndarray | None:
    """Return the prior std of an entry as an array, None if not given; `ValueError` if invalid."""
    if std is None:
        return None
    x = np.asarray(std, float).ravel()
    if x.size not in (1, entry.size) or not (np.isfinite(x) & (x > 0)).all():
        raise ValueError(
            f"{entry.path}: prior std {std}; expected one positive number for all elements, or one "
            f"per element ({entry.size})"
        )
    return x


def _checked_value(entry: Entry, value: Any, fixed: bool = False) -> np.ndarray:
    """Return a value as an array; `ValueError` if invalid. A scalar applies to all elements."""
    x = np.asarray(value, float)
    if x.size not in (1, entry.size):
        raise ValueError(f"{entry.path}: {x.size} values; expected {entry.size}")
    x = np.broadcast_to(x.ravel(), (entry.size,))
    if rule := entry.declaration.broken_rule(x, fixed):
        raise ValueError(f"{entry.path} = {value}: expected {rule}")
    return x.reshape(()) if entry.size == 1 else x
