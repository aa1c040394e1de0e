"""Two searches for gains on one budget of rollouts, each of which can be left and resumed.

Adam on differences through the twin (Kingma and Ba 2015), the gains being the mean of the last
third of its steps, and a particle swarm (Goswami and Padhy 2018) on as many cases at a time. Both
search one box, and a gradient counts as `GRADIENT` rollouts.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control.deployed import DeployedRobot
from slipid.control.tuning import objective
from slipid.control.tuning.objective import BATCH, GAINS, HAND, Cases, Task, box_of, gains_at

Method = Literal["gradient", "pso"]
GRADIENT = len(GAINS) + 1
"""Rollouts that a gradient by all gains takes."""
PARTICLES = 30
INERTIA, OWN, OTHERS = 0.7, 1.5, 1.5
"""Of a particle's speed, its pull to its own best place and to that of all."""
RATE = 0.12
"""First step of Adam, in parts of the box; it falls to a tenth along a cosine."""
_HALTS = 6
"""Places between the end of a search and the gains by hand where stability is asked for."""
State = dict[str, np.ndarray]
"""Of a search: plain arrays, so that it can be kept in a file."""


class Search:
    """A search that can be left and resumed after any step, with the same end.

    Args:
        task: what is tuned.
        cases: `BATCH` or more.
        stable: robots whose loops must be stable, stacked.
        method: by which; rollouts: that may be spent.
        seed: of the order of cases and of the swarm.
    """

    def __init__(
        self,
        task: Task,
        cases: Cases,
        stable: DeployedRobot,
        method: Method,
        rollouts: int,
        seed: int = 0,
    ):
        self.task, self.cases, self.stable = task, cases, stable
        self.method, self.seed = method, seed
        self.cost = BATCH * (GRADIENT if method == "gradient" else PARTICLES)
        self.steps = max(1, rollouts // self.cost)

    @property
    def rollouts(self) -> int:
        """Rollouts that are spent by its end."""
        return self.steps * self.cost

    def start(self) -> State:
        """Before the first step, at the gains set by hand."""
        x, count, zero = box_of(HAND), np.array(0), np.zeros(len(GAINS))
        if self.method == "gradient":
            return {"count": count, "x": x, "m": zero, "v": zero, "way": np.zeros((0, len(GAINS)))}
        rng = np.random.default_rng([self.seed, 0])
        x = np.concatenate([x[None], rng.uniform(size=(PARTICLES - 1, len(GAINS)))])
        none = np.full(PARTICLES, np.inf)
        return {"count": count, "x": x, "v": np.zeros_like(x), "own": x, "value": none}

    def done(self, state: State) -> bool:
        """Whether all rollouts are spent."""
        return int(state["count"]) >= self.steps

    def step(self, state: State) -> State:
        """One step on."""
        return self._adam(state) if self.method == "gradient" else self._swarm(state)

    def best(self, state: State) -> Float[np.ndarray, " gain"]:
        """Gains a search has come to, as far on the way there from those by hand as is stable."""
        end, hand = self._places(state).mean(axis=0), box_of(HAND)
        way = hand + np.linspace(1.0, 0.0, _HALTS)[:, None] * (end - hand)
        push = np.asarray(objective.penalties(self.task, jnp.asarray(way), self.stable))
        stable = np.flatnonzero(push <= 0)
        at = way[stable[0] if len(stable) else int(np.argmin(push))]
        return np.asarray(gains_at(jnp.asarray(at)))

    def spread(self, state: State) -> Float[np.ndarray, " gain"]:
        """Std of the gains: over Adam's last third, whose cases change, or the best particles."""
        places = self._places(state)
        if self.method == "pso":
            places = state["own"][np.argsort(state["value"])[: PARTICLES // 3]]
        return np.asarray(gains_at(jnp.asarray(places))).std(axis=0)

    def _places(self, state: State) -> np.ndarray:
        if self.method == "pso":
            return state["own"][[int(np.argmin(state["value"]))]]
        way = state["way"]
        return way[-max(1, self.steps // 3) :] if len(way) else state["x"][None]

    def _adam(self, state: State) -> State:
        k = int(state["count"])
        rng = np.random.default_rng([self.seed, k + 1])
        cases = self.cases.at(rng.choice(len(self.cases), BATCH, replace=False))
        x = jnp.asarray(state["x"])
        found, values = (np.asarray(a) for a in objective.slopes(self.task, x, cases))
        push = objective.penalty_slope(self.task, x, self.stable)
        worst = np.argsort(values)[-max(1, -(-BATCH // 10)) :]
        good = np.where(np.isfinite(found), found, 0.0)
        # one case where a floor's edge is touched must not decide
        size = np.linalg.norm(good, axis=1, keepdims=True)
        good = good * np.minimum(1.0, 5 * np.median(size) / np.maximum(size, 1e-9))
        g = good.mean(axis=0) + good[worst].mean(axis=0) + np.nan_to_num(push)
        m, v = 0.9 * state["m"] + 0.1 * g, 0.99 * state["v"] + 0.01 * g * g
        rate = RATE * (0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * k / self.steps)))
        move = m / (1 - 0.9 ** (k + 1)) / (np.sqrt(v / (1 - 0.99 ** (k + 1))) + 1e-8)
        new = np.clip(state["x"] - rate * move, 0.0, 1.0)
        way = np.concatenate([state["way"], new[None]])
        return {"count": np.array(k + 1), "x": new, "m": m, "v": v, "way": way}

    def _swarm(self, state: State) -> State:
        k = int(state["count"])
        rng = np.random.default_rng([self.seed, k + 1])
        cases, x = self.cases.at(np.arange(BATCH)), state["x"]
        parts = x.reshape(-1, 6, len(GAINS))  # few at a time need less memory
        push = [objective.penalties(self.task, jnp.asarray(part), self.stable) for part in parts]
        loss = [objective.losses(self.task, jnp.asarray(row), cases) for row in x]
        value = np.array([float(objective.combined(each)) for each in loss]) + np.concatenate(push)
        value = np.where(np.isfinite(value), value, np.inf)
        better = value < state["value"]
        own = np.where(better[:, None], x, state["own"])
        value = np.where(better, value, state["value"])
        lead = own[np.argmin(value)]
        one, two = rng.uniform(size=(2, *x.shape))
        v = INERTIA * state["v"] + OWN * one * (own - x) + OTHERS * two * (lead - x)
        v = np.clip(v, -0.5, 0.5)
        new = np.clip(x + v, 0.0, 1.0)
        return {"count": np.array(k + 1), "x": new, "v": v, "own": own, "value": value}
