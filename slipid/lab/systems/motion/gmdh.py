"""Andrakhanov and Belyaev predict slip by GMDH networks, one set for all floors or one for each.

There is a network of quadratic neurons (see `polynomial_network`) for each component of the body's
slip in half a second, over the inputs of `features`. `gmdh_one` has one set of networks whatever
the floor. `gmdh_class` first tells the floor and then uses the networks of that floor. It tells it
by one network g_k per floor, which is taught one on its own floor and zero on others:

    p_k = max(g_k, 0.05) / sum_j max(g_j, 0.05)              of one window
    e_k <- 0.9 e_k + log p_k,   P_k = exp(e_k) / sum_j exp(e_j)    of the run so far

and takes the floor of the largest P_k. A floor that is told and was seen is used instead.

Two settings are tuned: the ridge and the number of layers.

Liberties:
    - The papers predict displacement by a robot with other sensors; here it is slip as a ratio, of
      the same half second, from the inputs that all learned methods get.
    - Halves A and B are runs drawn at random, of every floor alike, since windows of one run are as
      good as copies of each other.
    - Ridge replaces plain least squares; inputs and outputs are clipped to what was seen.
    - Slow windows count less in the networks of slip; floors count alike in those of floors.
    - Evidence on the floor is added up along the run and fades, since a run may cross floors. What
      is said of floors is from what is heard, also where the floor is told.
    - Floors that were never seen with the load at hand, which a robot knows, are left out.
    - Twenty neurons of a layer are kept and inputs of earlier layers are not offered again.

Source: Andrakhanov, Belyaev 2017, Navigation learning system for mobile robot in heterogeneous
environment: inductive modeling approach, CSIT; Andrakhanov, Belyaev 2018, GMDH-based learning
system for mobile robot navigation in heterogeneous environment, Advances in Intelligent Systems and
Computing 689.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.lab.systems.motion.features import (
    Inputs,
    Scale,
    SignalWindows,
    SlipExamples,
    at_steps,
    with_slip,
)
from slipid.lab.systems.motion.polynomial_network import Growth, PolynomialNetwork, grown
from slipid.predict.slip_model import Channel, PredictedRun, RobotSpec, Run, RunSignals, SlipModel

KEPT = 20
LEAST = 0.05
"""Probability that one window leaves to a floor at least: outputs of networks may be negative."""
MEMORY = 0.9
"""Share of the evidence that is left after a window."""
CANDIDATES = (
    Growth(1e-3, KEPT, 5),
    Growth(1e-1, KEPT, 5),
    Growth(1e-2, KEPT, 1),
    Growth(1.0, KEPT, 1),
)
SEED = 0


@dataclass(frozen=True, eq=False)
class NetworkSet:
    """A network for each of several outputs, with the scales of inputs and outputs."""

    inputs: Scale
    outputs: Scale
    each: Sequence[PolynomialNetwork]

    @classmethod
    def grown(
        cls,
        x: Inputs,
        y: Float[np.ndarray, "window output"],
        weight: Float[np.ndarray, " window"],
        in_a: Bool[np.ndarray, " window"],
        growth: Growth,
    ) -> "NetworkSet":
        inputs, outputs = Scale.of(x), Scale.of(y)
        seen, said = inputs.scaled(x), outputs.scaled(y)
        each = [grown(seen, column, weight, in_a, growth) for column in said.T]
        return cls(inputs, outputs, each)

    def say(self, x: Inputs) -> Float[np.ndarray, "window output"]:
        seen = self.inputs.scaled(x)
        said = self.outputs.back(np.stack([network.output(seen) for network in self.each], axis=1))
        return np.asarray(said.clip(self.outputs.low, self.outputs.high))

    @property
    def numbers(self) -> int:
        return sum(network.numbers for network in self.each)


@final
@dataclass(frozen=True, eq=False)
class GmdhOne(SlipModel):
    """One set of networks for all floors.

    Attributes:
        growth: how networks are grown.
        channels: beside the encoders, that inputs are of.
        networks: of the slip ratio's three components.
    """

    name: str = "gmdh_one"
    growth: Growth = CANDIDATES[0]
    channels: frozenset[Channel] = frozenset()
    networks: NetworkSet | None = None

    def candidates(self) -> Sequence["GmdhOne"]:
        return [replace(self, growth=growth) for growth in CANDIDATES]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "GmdhOne":
        seen = SlipExamples.of(runs, spec)
        in_a = first_half(seen.run, [run.floor for run in runs])
        networks = NetworkSet.grown(seen.inputs, seen.ratio, seen.weight, in_a, self.growth)
        return replace(self, channels=seen.channels, networks=networks)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.networks is None:
            raise ValueError(f"{self.name}: predict before fit")
        windows = SignalWindows.of(runs, spec)
        ratio = self.networks.say(windows.inputs(spec, self.channels))
        return with_slip(runs, windows, ratio, spec)

    @property
    def numbers(self) -> int:
        return 0 if self.networks is None else self.networks.numbers


@final
@dataclass(frozen=True, eq=False)
class GmdhClass(SlipModel):
    """Networks that tell the floor, and then those of the slip on that floor.

    Attributes:
        growth: how networks are grown.
        channels: beside the encoders, that inputs are of.
        floors: networks of the slip ratio's three components on each floor.
        loads: load set-ups with which each floor was seen, in the same order.
        telling: networks of the floors, in the same order; None where only one floor was seen.
    """

    name: str = "gmdh_class"
    growth: Growth = CANDIDATES[0]
    channels: frozenset[Channel] = frozenset()
    floors: Mapping[str, NetworkSet] = field(default_factory=dict)
    loads: Sequence[frozenset[str | None]] = ()
    telling: NetworkSet | None = None

    def candidates(self) -> Sequence["GmdhClass"]:
        return [replace(self, growth=growth) for growth in CANDIDATES]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "GmdhClass":
        seen = SlipExamples.of(runs, spec)
        floor_of_run = [run.floor for run in runs]
        in_a = first_half(seen.run, floor_of_run)
        # a floor on which no wheel turned is none that was seen
        named = np.array(floor_of_run)[seen.run]
        names = [name for name in dict.fromkeys(floor_of_run) if name in named]
        on = np.stack([named == name for name in names], axis=1)
        floors = {
            name: NetworkSet.grown(
                seen.inputs[mine], seen.ratio[mine], seen.weight[mine], in_a[mine], self.growth
            )
            for name, mine in zip(names, on.T, strict=True)
        }
        telling = None
        if len(names) > 1:
            alike = (on / on.sum(axis=0)).sum(axis=1)
            telling = NetworkSet.grown(seen.inputs, on.astype(float), alike, in_a, self.growth)
        loads = [frozenset(run.signals.load for run in runs if run.floor == name) for name in names]
        return replace(self, channels=seen.channels, floors=floors, loads=loads, telling=telling)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if not self.floors:
            raise ValueError(f"{self.name}: predict before fit")
        windows, names = SignalWindows.of(runs, spec), list(self.floors)
        inputs = windows.inputs(spec, self.channels)
        belief = self._belief(windows, inputs, runs)
        told = np.array([names.index(run.floor) if run.floor in names else -1 for run in runs])
        floor = np.where(told[windows.run] < 0, belief.argmax(axis=1), told[windows.run])
        ratio = np.zeros((len(inputs), 3))
        for number, networks in enumerate(self.floors.values()):
            ratio[floor == number] = networks.say(inputs[floor == number])
        said = with_slip(runs, windows, ratio, spec)
        return [
            replace(of_run, floors=dict(zip(names, belief_of_run.T, strict=True)))
            for of_run, belief_of_run in zip(said, at_steps(belief, windows, runs), strict=True)
        ]

    def _belief(
        self, windows: SignalWindows, inputs: Inputs, runs: Sequence[RunSignals]
    ) -> Float[np.ndarray, "window floor"]:
        """Probability of each floor by all of a run that was heard up to each window.

        A floor that was never seen with the run's load is none that it may be on.
        """
        if self.telling is None:
            return np.ones((len(inputs), 1))
        share = self.telling.say(inputs).clip(min=LEAST)
        evidence = np.log(share / share.sum(axis=1, keepdims=True))
        # a robot at rest tells nothing
        evidence[~windows.moves] = 0.0
        seen = np.array([[run.load in loads for loads in self.loads] for run in runs])
        seen |= ~seen.any(axis=1, keepdims=True)
        total = remembered(evidence, windows.run)
        return _softmax(np.where(seen[windows.run], total, -np.inf))

    @property
    def numbers(self) -> int:
        telling = 0 if self.telling is None else self.telling.numbers
        return telling + sum(networks.numbers for networks in self.floors.values())


def first_half(
    run: Int[np.ndarray, " window"], floor_of_run: Sequence[str]
) -> Bool[np.ndarray, " window"]:
    """Half A of the windows: those of half of each floor's runs; of a single run, every other."""
    rng = np.random.default_rng(SEED)
    floors = np.array(floor_of_run)[run]
    in_a = np.zeros(len(run), dtype=bool)
    for floor in dict.fromkeys(floors.tolist()):
        mine = np.flatnonzero(floors == floor)
        drawn = rng.permutation(np.unique(run[mine]))
        if len(drawn) > 1:
            in_a[mine] = np.isin(run[mine], drawn[: (len(drawn) + 1) // 2])
        else:
            in_a[mine[::2]] = True
    return in_a


def remembered(
    evidence: Float[np.ndarray, "window floor"], run: Int[np.ndarray, " window"]
) -> Float[np.ndarray, "window floor"]:
    """Evidence of each run so far, what is older fading away."""
    place = np.arange(len(run)) - np.searchsorted(run, run)
    total = evidence.copy()
    # all runs at once, each place after the one before it
    for k in range(1, place.max(initial=0) + 1):
        here = np.flatnonzero(place == k)
        total[here] += MEMORY * total[here - 1]
    return total


def _softmax(x: Float[np.ndarray, "window floor"]) -> Float[np.ndarray, "window floor"]:
    odds = np.exp(x - x.max(axis=1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))
