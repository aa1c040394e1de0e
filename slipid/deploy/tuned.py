"""What a search for gains has come to, and the content of gains.json."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control.closed_loop import PERIOD
from slipid.control.controller import Gains
from slipid.control.deployed import DeployedRobot
from slipid.control.robot_file.record import GainRecord, GainsRecord, GainValues, Losses
from slipid.control.tuning.objective import (
    BATCH,
    GAINS,
    HAND,
    UNITS,
    Cases,
    combined,
    evaluate,
)
from slipid.control.tuning.optimisers import GRADIENT, Search, State

SCHEMA = "slipid.gains/1"
CORNERS = ((0.0, 0.0), (0.4, 0.0), (0.4, -0.2))
"""Of the path that is rehearsed [m]."""
DRAWS = 16
"""Of the robot, to search with and to judge on."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """What a search has come to.

    Attributes:
        search: what was tuned, and how.
        best, spread: gains and their stds over the end of the search, in the order of `GAINS`.
        losses: of every case not tuned on [mm], by hand and tuned.
        margins: 1 - spectral radius of every loop of every draw, by hand and tuned.
    """

    search: Search
    best: Float[np.ndarray, " gain"]
    spread: Float[np.ndarray, " gain"]
    losses: Mapping[str, Float[np.ndarray, " case"]]
    margins: Mapping[str, Float[np.ndarray, "draw loop"]]

    def record(self) -> GainsRecord:
        """As robot.json has it."""
        loss = Losses(**{k: float(combined(jnp.asarray(v))) for k, v in self.losses.items()})
        task, better = self.search.task, self.losses["tuned"] < self.losses["hand"]
        rows = zip(GAINS, self.best, UNITS, self.spread, strict=True)
        return GainsRecord(
            values=GainValues(**{g: GainRecord(float(v), u, float(s)) for g, v, u, s in rows}),
            load=task.robot.load_setup,
            gyro=task.habits.gyro,
            method=self.search.method,
            loss=loss,
            better_than_hand=float(better.mean()),
            stability_margin=float(self.margins["tuned"].min()),
            verdict="no worse than by hand" if loss.tuned <= loss.hand else "worse than by hand",
        )

    def to_json(self) -> dict[str, object]:
        """Content of gains.json."""
        task, kept, record = self.search.task, self.search, self.record()
        quantiles = {k: np.quantile(v, [0.05, 0.95]).tolist() for k, v in self.losses.items()}
        return {
            "schema": SCHEMA,
            "gains": asdict(record.values),
            "method": kept.method,
            "rollouts": kept.rollouts,
            "loss": asdict(record.loss),
            "loss_mean": {k: float(v.mean()) for k, v in self.losses.items()},
            "loss_interval90": quantiles,
            "better_than_hand": record.better_than_hand,
            "stability_margin": {
                "worst": record.stability_margin,
                "median": float(np.median(self.margins["tuned"])),
                "hand_worst": float(self.margins["hand"].min()),
                "draws": self.margins["tuned"].min(axis=1).tolist(),
            },
            "settings": {
                "loss_unit": "mm",
                "cases": len(kept.cases),
                "judged_on": len(self.losses["tuned"]),
                "draws": DRAWS,
                "batch": BATCH,
                "gradient_counts_as": GRADIENT,
                "path_m": [list(c) for c in CORNERS],
                "delay_s": task.habits.delay_s,
                "lag_s": task.habits.lag_s,
                "period_s": PERIOD,
                "steps": task.steps,
                "hand": dict(zip(GAINS, HAND, strict=True)),
                "load": record.load,
                "gyro": record.gyro,
                "voltage": task.habits.voltage,
            },
            "seed": kept.seed,
            "fit": hashes(task.robot),
        }


def hashes(robot: DeployedRobot) -> dict[str, str | None]:
    """Of the runs a robot was made of, and of its numbers."""
    return {"data": robot.record.data, "numbers": robot.record.numbers}


def judged(search: Search, state: State, others: Cases, stable: DeployedRobot) -> Tuned:
    """The end of a search, on cases it has not seen."""
    task, best = search.task, search.best(state)
    by = {"hand": np.asarray(HAND), "tuned": best}
    return Tuned(
        search=search,
        best=best,
        spread=search.spread(state),
        losses={name: evaluate(task, g, others) for name, g in by.items()},
        margins={name: task.margins(Gains.at(g), stable) for name, g in by.items()},
    )
