"""What a row of the benchmark came to in one fold, or why it is not there."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from slipid.benchmark.judge import RunScore


@dataclass(frozen=True)
class Row:
    """A method in one fold of one protocol.

    Attributes:
        runs: that it predicted.
        absent: why there are none: a channel that it needs and these logs lack, or what failed.
        failed: whether that is a failure.
        settings: that cross-validation picked, in words; tried: how many.
        numbers: how many were fitted.
        tune_s, fit_s: that it took to pick the settings, and to fit once [s].
        step_us: to predict one step of one run [microseconds].
        converged: of a fit that goes in rounds.
    """

    runs: tuple[RunScore, ...] = ()
    absent: str = ""
    failed: bool = False
    settings: str = ""
    tried: int = 1
    numbers: int = 0
    tune_s: float = 0.0
    fit_s: float = 0.0
    step_us: float = 0.0
    converged: bool = True

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of_json(cls, content: dict[str, Any]) -> "Row":
        return cls(**{**content, "runs": tuple(RunScore(**run) for run in content["runs"])})

    @classmethod
    def lacking(cls, channels: Iterable[str]) -> "Row":
        """Of a method that needs what was not logged."""
        words = {"twist": "wheels that drive sideways", "command": "a commanded twist"}
        named = [words.get(name, f"a {name}") for name in sorted(channels)]
        return cls(absent=f"needs {' and '.join(named)}")

    @classmethod
    def of_error(cls, error: Exception) -> "Row":
        """Of a method that ended in an error."""
        return cls(absent=f"{type(error).__name__}: {error}".splitlines()[0][:300], failed=True)
