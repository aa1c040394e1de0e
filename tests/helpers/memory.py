"""A checkpoint in memory, with the blocks of a sampler's chain."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from slipid.infer.posterior.blocks import ChainBlock, packed, unpacked
from slipid.support.checkpoint import Checkpoint


@dataclass(frozen=True)
class Memory(Checkpoint):
    """Checkpoint whose parts are in a dict."""

    folder: Path = Path("memory")
    key: str = ""
    parts: dict = field(default_factory=dict)

    def save(self, name, arrays):
        self.parts[name] = dict(arrays)

    def load(self, name):
        return self.parts.get(name)

    def first(self, count: int) -> Memory:
        """Return a checkpoint with the first blocks of every part."""
        parts = {k: v for k, v in self.parts.items() if int(k.rpartition("-")[2]) < count}
        return Memory(parts=parts)

    @property
    def blocks(self) -> list[tuple[str, ChainBlock]]:
        """Part and block of everything that was saved."""
        return [(name.rpartition("-")[0], unpacked(arrays)) for name, arrays in self.parts.items()]


def holding(part: str, blocks) -> Memory:
    """Return a checkpoint with these blocks of a part."""
    return Memory(parts={f"{part}-{k:04d}": packed(block) for k, block in enumerate(blocks)})
