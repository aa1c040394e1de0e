"""Named numbers in one flat array: one leaf costs a jitted call least to dispatch."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Layout:
    """Which number lies where.

    Attributes:
        fields: (name, shape) in the order of the array.
    """

    fields: tuple[tuple[str, tuple[int, ...]], ...]

    @property
    def size(self) -> int:
        """Length of the array."""
        return sum(math.prod(shape) for _, shape in self.fields)

    def place(self, name: str) -> slice:
        """Where a field lies.

        Raises:
            KeyError: no such field; names those there are.
        """
        start = 0
        for field, shape in self.fields:
            size = math.prod(shape)
            if field == name:
                return slice(start, start + size)
            start += size
        raise KeyError(f"no field '{name}'; there are {', '.join(f for f, _ in self.fields)}")

    def pack(self, **parts: Any) -> Float[Array, " packed"]:
        """Array of the named parts; every field must be given.

        Raises:
            KeyError: a part that is no field, or a field that is not given.
        """
        names = {name for name, _ in self.fields}
        if parts.keys() != names:
            raise KeyError(f"given {sorted(parts)}; expected {sorted(names)}")
        flat = [jnp.broadcast_to(jnp.asarray(parts[n]), s).reshape(-1) for n, s in self.fields]
        return jnp.concatenate([x.astype(float) for x in flat])

    def of(self, packed: Float[Array, "*batch packed"]) -> Any:
        """The parts by name, with the batch axes in front."""
        out, start = {}, 0
        for name, shape in self.fields:
            size = math.prod(shape)
            part = packed[..., start : start + size]
            out[name] = part.reshape(packed.shape[:-1] + shape)
            start += size
        return SimpleNamespace(**out)
