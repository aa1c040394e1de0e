"""Errors of fitted motors on held-out rows, beside those of rivals."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from slipid.infer.verdicts.estimates import NEEDS_VOLTAGE, Estimate
from slipid.support.content import Content

BETTER = 0.98
"""Ratio of root mean squares below which a rival predicts better."""


@dataclass(frozen=True)
class Errors:
    """Root mean square errors of predicted readings.

    Attributes:
        speed: of the speed, None if it was not predicted [rad/s].
        current: of the current, None if it was not logged [A].
    """

    speed: float | None
    current: float | None

    def to_json(self) -> Content:
        return {"speed_rmse_rad_s": self.speed, "current_rmse_a": self.current}

    @classmethod
    def of_json(cls, content: Content) -> "Errors":
        """Return the errors whose `to_json` was stored."""
        return cls(content["speed_rmse_rad_s"], content["current_rmse_a"])

    def better(self, other: "Errors") -> bool:
        """Return True if a channel is predicted better than by `other`."""
        pairs = ((self.speed, other.speed), (self.current, other.current))
        return any(a is not None and b is not None and a < BETTER * b for a, b in pairs)


@dataclass(frozen=True)
class HeldOut:
    """Errors of predicted readings that were not used by the fits.

    Attributes:
        errors: errors of the fitted motor.
        rivals: errors of least squares, keyed by name.
    """

    errors: Errors
    rivals: dict[str, Errors]

    @property
    def worse_than(self) -> tuple[str, ...]:
        """Names of the rivals that predict a channel better."""
        return tuple(name for name, e in self.rivals.items() if e.better(self.errors))

    def to_json(self) -> Content:
        rivals = {name: e.to_json() for name, e in self.rivals.items()}
        return {**self.errors.to_json(), "rivals": rivals}

    @classmethod
    def of_json(cls, content: Content) -> "HeldOut":
        """Return the errors whose `to_json` was stored."""
        rivals = {name: Errors.of_json(e) for name, e in content["rivals"].items()}
        return cls(Errors.of_json(content), rivals)


def doubted(found: Mapping[str, Estimate], held_out: HeldOut | None) -> dict[str, Estimate]:
    """Return estimates; those of R, C_e and R / C_e are at most weak if a rival predicts better."""
    if held_out is None or not held_out.worse_than:
        return dict(found)
    weak = {*NEEDS_VOLTAGE, "/".join(NEEDS_VOLTAGE)}
    return {
        path: replace(e, verdict="weak") if path in weak and e.verdict == "identified" else e
        for path, e in found.items()
    }
