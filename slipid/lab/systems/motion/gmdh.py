"""Andrakhanov and Belyaev: slip predicted by GMDH networks, one set for all floors or one for each.

Each component of the body's slip ratio in windows of half a second is the output of a network of
quadratic neurons (see `polynomial_network`), whose inputs are those of `features`. `gmdh_one` has
one set of networks for all floors. `gmdh_class` first classifies the floor and then uses the
networks of that floor. Its classifier has one network g_k per floor, trained to give one on its own
floor and zero on others:

    p_k = max(g_k, 0.05) / sum_j max(g_j, 0.05)                    for one window
    e_k <- 0.9 e_k + log p_k,   P_k = exp(e_k) / sum_j exp(e_j)    for the run so far

The floor with the largest P_k is used, unless the floor is given and was among the training floors.

Two settings are tuned: the ridge and the number of layers.

Liberties:
    - The papers predict the displacement of a robot with other sensors. Here the networks predict
      the slip ratio in the same half second, from the inputs that all learned methods get.
    - Halves A and B of the data are random halves of each floor's runs, not of its windows, since
      windows of one run are nearly copies of each other.
    - Ridge replaces plain least squares; inputs and outputs are clipped to the training range.
    - Slow windows have less weight in the networks for slip; all floors have the same total weight
      in the networks of the classifier.
    - Evidence about the floor is accumulated along the run and fades, since a run may cross floors.
      The reported floor probabilities always come from the signals, even if the floor is given.
    - The robot knows its load set-up: floors without training runs in this set-up have probability
      zero.
    - Twenty neurons of a layer are kept, and the next layer has only their outputs as inputs.

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
from scipy.special import softmax

from slipid.lab.systems.motion.features import (
    Inputs,
    LearnedSlip,
    Scale,
    SignalWindows,
    SlipExamples,
    at_steps,
    with_slip,
)
from slipid.lab.systems.motion.polynomial_network import Growth, PolynomialNetwork, grown
from slipid.predict.slip_model import Channel, PredictedRun, RobotSpec, Run, RunSignals, SlipModel

KEPT_NEURONS = 20
"""Number of neurons of a layer whose outputs are the inputs of the next layer."""
LOWEST_OUTPUT = 0.05
"""Lower limit to which the classifier's possibly negative output for a floor and window is raised.
"""
EVIDENCE_MEMORY = 0.9
"""Factor by which evidence about the floor fades from window to window."""
CANDIDATES = (
    Growth(1e-3, KEPT_NEURONS, 5),
    Growth(1e-1, KEPT_NEURONS, 5),
    Growth(1e-2, KEPT_NEURONS, 1),
    Growth(1.0, KEPT_NEURONS, 1),
)
SEED = 0


@dataclass(frozen=True, eq=False)
class NetworkSet:
    """Networks for several outputs, one for each.

    Attributes:
        inputs: standardisation of the inputs.
        outputs: standardisation of the outputs.
        each: network of each output.
    """

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
        """Return networks fitted to windows of half A and selected by their errors in half B."""
        inputs, outputs = Scale.of(x), Scale.of(y)
        scaled = inputs.scaled(x)
        each = [grown(scaled, column, weight, in_a, growth) for column in outputs.scaled(y).T]
        return cls(inputs, outputs, each)

    def predict(self, X: Inputs) -> Float[np.ndarray, "window output"]:
        """Return the outputs, clipped to their training range."""
        scaled = self.inputs.scaled(X)
        return self.outputs.back(np.stack([one.output(scaled) for one in self.each], axis=1))

    @property
    def numbers(self) -> int:
        """Number of weights."""
        return sum(network.numbers for network in self.each)


@final
@dataclass(frozen=True, eq=False)
class GmdhOne(LearnedSlip):
    """Slip model with one set of networks for all floors.

    Attributes:
        growth: settings of the networks' growth.
        regressor: networks of the slip ratio's three components; None before a fit.
    """

    name: str = "gmdh_one"
    growth: Growth = CANDIDATES[0]
    regressor: NetworkSet | None = None

    def candidates(self) -> Sequence["GmdhOne"]:
        return [replace(self, growth=growth) for growth in CANDIDATES]

    def trained(self, examples: SlipExamples) -> "GmdhOne":
        in_a = first_half(examples.run, examples.floor)
        x, y, weight = examples.inputs, examples.ratio, examples.weight
        return replace(self, regressor=NetworkSet.grown(x, y, weight, in_a, self.growth))

    @property
    def numbers(self) -> int:
        return 0 if self.regressor is None else self.regressor.numbers


@final
@dataclass(frozen=True, eq=False)
class GmdhClass(SlipModel):
    """Slip model that classifies the floor by networks, and has networks of the slip on each floor.

    Attributes:
        growth: settings of the networks' growth.
        channels: channels of the inputs besides the encoders.
        floors: networks of the slip ratio's three components on each floor.
        loads: load set-ups of the training runs on each floor, in the same order.
        classifier: networks of the floors, in the same order; None if there is only one floor.
    """

    name: str = "gmdh_class"
    growth: Growth = CANDIDATES[0]
    channels: frozenset[Channel] = frozenset()
    floors: Mapping[str, NetworkSet] = field(default_factory=dict)
    loads: Sequence[frozenset[str | None]] = ()
    classifier: NetworkSet | None = None

    def candidates(self) -> Sequence["GmdhClass"]:
        return [replace(self, growth=growth) for growth in CANDIDATES]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "GmdhClass":
        data = SlipExamples.of(runs, spec)
        in_a = first_half(data.run, data.floor)
        # list the floors of windows, not of runs: a floor on which no wheel turned has no window
        names = list(dict.fromkeys(data.floor.tolist()))
        on = np.stack([data.floor == name for name in names], axis=1)
        floors = {
            name: NetworkSet.grown(
                data.inputs[mine], data.ratio[mine], data.weight[mine], in_a[mine], self.growth
            )
            for name, mine in zip(names, on.T, strict=True)
        }
        classifier = None
        if len(names) > 1:
            equal = (on / on.sum(axis=0)).sum(axis=1)
            classifier = NetworkSet.grown(data.inputs, on.astype(float), equal, in_a, self.growth)
        loads = [frozenset(run.signals.load for run in runs if run.floor == name) for name in names]
        return replace(
            self, channels=data.channels, floors=floors, loads=loads, classifier=classifier
        )

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if not self.floors:
            raise ValueError(f"{self.name} was not fitted; expected a call of fit before predict")
        windows, names = SignalWindows.of(runs, spec), list(self.floors)
        inputs = windows.inputs(spec, self.channels)
        belief = self._belief(windows, inputs, runs)
        given = np.array([names.index(run.floor) if run.floor in names else -1 for run in runs])
        floor = np.where(given[windows.run] < 0, belief.argmax(axis=1), given[windows.run])
        ratio = np.zeros((len(inputs), 3))
        for number, networks in enumerate(self.floors.values()):
            ratio[floor == number] = networks.predict(inputs[floor == number])
        predicted = with_slip(runs, windows, ratio, spec)
        return [
            replace(of_run, floors=dict(zip(names, belief_of_run.T, strict=True)))
            for of_run, belief_of_run in zip(
                predicted, at_steps(belief, windows, runs), strict=True
            )
        ]

    def _belief(
        self, windows: SignalWindows, inputs: Inputs, runs: Sequence[RunSignals]
    ) -> Float[np.ndarray, "window floor"]:
        """Return the probability of each floor from a run's signals up to each window.

        A floor without training runs in the run's load set-up has probability zero.
        """
        if self.classifier is None:
            return np.ones((len(inputs), 1))
        share = self.classifier.predict(inputs).clip(min=LOWEST_OUTPUT)
        evidence = np.log(share / share.sum(axis=1, keepdims=True))
        # ignore windows at rest, whose signals contain no evidence about the floor
        evidence[~windows.moving] = 0.0
        possible = np.array([[run.load in loads for loads in self.loads] for run in runs])
        possible |= ~possible.any(axis=1, keepdims=True)
        total = remembered(evidence, windows.run)
        return np.asarray(softmax(np.where(possible[windows.run], total, -np.inf), axis=1))

    @property
    def numbers(self) -> int:
        networks = [*self.floors.values(), *([self.classifier] if self.classifier else [])]
        return sum(each.numbers for each in networks)


def first_half(run: Int[np.ndarray, " window"], floors: np.ndarray) -> Bool[np.ndarray, " window"]:
    """Return True for the windows of half A, which has a random half of the runs on each floor.

    On a floor with only one run, half A has every other window. `floors` names the floor of each
    window.
    """
    rng = np.random.default_rng(SEED)
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
    """Return the evidence accumulated up to each window of a run; older evidence fades."""
    place = np.arange(len(run)) - np.searchsorted(run, run)
    total = evidence.copy()
    # the k-th windows of all runs are updated together
    for k in range(1, place.max(initial=0) + 1):
        here = np.flatnonzero(place == k)
        total[here] += EVIDENCE_MEMORY * total[here - 1]
    return total
