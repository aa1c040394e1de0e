"""Telling floors from currents and a gyro, as a part of the whole benchmark."""

from dataclasses import dataclass

from slipid.benchmark.felt.benchmark import FOLDER, felt_benchmark
from slipid.benchmark.row import Row
from slipid.benchmark.work import Wish
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.files import hash_of
from slipid.support.jax_setup import setup_jax


@dataclass(frozen=True)
class FloorsFelt:
    """The part of the work that tells floors without a pose."""

    wish: Wish
    name: str = "floors_felt"

    @property
    def is_there(self) -> bool:
        """Whether its logs are."""
        return (self.wish.data / FOLDER).is_dir()

    @property
    def kept(self) -> Checkpoint:
        """Where its table is kept."""
        files = sorted((self.wish.data / FOLDER).glob("*/*.csv"))
        content = hash_of((path.name, str(path.stat().st_size)) for path in files)
        code = source_hash("model", "control", "baselines", "benchmark")
        key = key_of(content, self.wish.quick, self.wish.only, code)
        return Checkpoint(self.wish.out / "kept", key)

    def run(self) -> str:
        """Fit and judge all classifiers, if that is not kept yet; the name of the part."""
        setup_jax(quiet=True)
        kept = self.kept
        if kept.load_json(self.name) is None:
            try:
                table = felt_benchmark(self.wish.data, self.wish.quick, self.wish.only)
                kept.save_json(self.name, table.to_json())
            except Exception as error:  # other parts are done all the same
                kept.save_json(self.name, {"failed": Row.of_error(error).absent})
        return self.name

    def table(self) -> Content:
        """What was found, as in benchmark.json."""
        found: Content = self.kept.load_json(self.name) or {"failed": "it was not kept"}
        return found
