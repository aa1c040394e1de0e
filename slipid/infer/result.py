"""Result of a fit: parameters with intervals and verdicts on their identifiability.

The modules for showing, sampling, deploying and writing a fit are loaded when a method needs them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.fitting.calibration.result import Calibration
from slipid.fitting.noise import POOLED
from slipid.fitting.optimise import Optimum
from slipid.fitting.problem import Problem
from slipid.fitting.shared_effects import FittedEffects
from slipid.fitting.variances import Search, Square
from slipid.infer.held_out import HeldOut, doubted
from slipid.infer.slip_curves import SlipCurve
from slipid.infer.verdicts.disputed import LoadComparison, load_comparisons, marked
from slipid.infer.verdicts.draws import Draws, some_of
from slipid.infer.verdicts.estimates import Estimate, derived, estimates
from slipid.infer.verdicts.profile import Profile, profile
from slipid.infer.verdicts.trust import Trust, verdict_of_trust
from slipid.infer.verdicts.unidentified import FlatDirection, flat_directions, members, sentences
from slipid.model.geometry import Geometry
from slipid.model.kinematics import with_lengths
from slipid.model.robot import Robot, Validity
from slipid.predict.open_loop import Tracks, tracks_from_increments
from slipid.predict.predictive import ForceBalance
from slipid.predict.ranking import Comparison, compared
from slipid.predict.selection import FloorSelection
from slipid.predict.slip_models import restored
from slipid.predict.validation import Validation, validation
from slipid.search_space import Choice, Space
from slipid.support.files import hash_of
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from slipid.infer.design.proposal import Design
    from slipid.infer.posterior.blocks import Plan
    from slipid.infer.posterior.diagnosis import Posterior
    from slipid.robot.deployed import DeployedRobot

Evidence = TypeVar("Evidence")

CONFLICT_STDS = 4.0
"""Distance of a parameter from its prior mean above which a message warns [prior std]."""


@dataclass(frozen=True)
class Channels:
    """Channels of the fitted logs.

    Attributes:
        current: True if currents are logged.
        voltage: True if voltages are logged.
        signed: True if currents have a sign, False if they are magnitudes.
        gyro: True if every run has the yaw rates of a gyro.
        windows: number of windows per segment.
    """

    current: bool = True
    voltage: bool = False
    signed: bool = False
    gyro: bool = False
    windows: int = 4


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters with their uncertainty; `print` shows all, and `fit[path]` returns one.

    Attributes:
        space: free and fixed parameters with their priors; its template holds the fixed values.
        choices: user's priors, start values and fixed values.
        z: search vector at the optimum.
        covariance: Laplace covariance of the search vector, with shared effects marginalised.
        laplace: Laplace covariance as if runs shared no effects.
        shared: fitted shared effects of neighbouring runs, keyed by floor.
        extrapolation: factors, keyed by floor@load, that multiply the variances of parameters and
            shared effects when runs are predicted that were not fitted.
        variance: variance components, those of sessions included, keyed by name [unit squared].
        variance_unit: unit of each component's std.
        runs: (name, sha256) of every fitted run, runs over several floors last.
        channels: logged channels.
        curves: curve of slip over torque, keyed by floor.
        current_trend: a [A] and b [A s/m] of the line a + b v fitted to measured less predicted
            currents, v the speed of the body.
        validity: ranges that the runs on each floor cover.
        converged: True if the last round changed little and the remaining step is small.
        reason: sentence on how the fit ended.
        rounds: number of rounds.
        history: loss after each round.
        remaining: largest coordinate of the full Gauss-Newton step at the end [posterior std]; if
            it is large, the solver stopped away from an optimum.
        lag: camera lag for which the windows were cut [s].
        seed: seed of the draws from which the bands of the curves are computed.
        baselines: fitted parameters of simpler slip models, for comparison.
        calibration: calibrated kinematics and pose sensor; None for a fit without them.
        selection: selected slip model and errors of held-out runs, keyed by floor; empty if no
            model was selected.
        suspects: suspected errors in logs and config, one sentence each.
        robot_settings: limits of the robot, noise of its sensors and delays of its actuators, as
            far as config or logs give them: value and origin ("config" or "logs"), keyed by path in
            robot.json.
        held_out: errors of motor currents that are predicted from voltages, beside those of least
            squares; None without currents and voltages.
        mixed: test of the runs over several floors: their prediction errors in a fit to all other
            runs, and in fits that include half of them; and the end-point errors of the runs on one
            floor, keyed by floor, before and after the runs over several floors were added; and
            the search vector `near`, for whose robot the windows of these runs were cut.
        refused: the content of `mixed`, with a reason, if the runs over several floors contradict
            the runs on one floor and were therefore not fitted.
        data: runs on one floor each; None for a fit that was loaded from its files.
        problem: likelihood of all fitted runs; None for a loaded fit.
        optimum: result of the optimisation; None for a loaded fit.
        chain: draws of a short chain around the fit; None without one, or if it has too few.
    """

    space: Space
    choices: tuple[Choice, ...]
    z: Search
    covariance: Square
    laplace: Square
    variance: Mapping[str, float]
    variance_unit: Mapping[str, str]
    runs: tuple[tuple[str, str], ...]
    channels: Channels
    curves: Mapping[str, SlipCurve]
    validity: Mapping[str, Validity]
    converged: bool
    reason: str
    rounds: int
    remaining: float
    history: tuple[float, ...]
    lag: float
    seed: int
    baselines: Mapping[str, Any] = field(default_factory=dict)
    calibration: Calibration | None = None
    selection: Mapping[str, FloorSelection] = field(default_factory=dict)
    suspects: tuple[str, ...] = ()
    robot_settings: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    current_trend: tuple[float, float] = (0.0, 0.0)
    held_out: HeldOut | None = None
    mixed: Mapping[str, Any] | None = None
    refused: Mapping[str, Any] | None = None
    shared: Mapping[str, FittedEffects] = field(default_factory=dict)
    extrapolation: Mapping[str, float] = field(default_factory=dict)
    data: Runs | None = None
    problem: Problem | None = None
    optimum: Optimum | None = None
    chain: Draws | None = None

    def __str__(self) -> str:
        from slipid.report.estimates import show_fit
        from slipid.report.page import text_of

        return text_of(show_fit, self)

    def __repr__(self) -> str:
        """Return the table, so that a notebook shows it."""
        return str(self)

    def __getitem__(self, path: str) -> Estimate:
        """Return the parameter of a path with its interval and verdict.

        Raises:
            KeyError: the fit has no such parameter; the message lists all.
        """
        if path not in self.parameters:
            raise KeyError(f"no parameter '{path}'; there are {', '.join(self.parameters)}")
        return self.parameters[path]

    def plot(self, name: str) -> "Figure":
        """Draw one of the fit's figures.

        Args:
            name: `load_share`, `slip_by_heading`, `slip_by_torque`, `current_by_traction` or
                `paths`.

        Raises:
            ValueError: there is no such figure, or the runs lack the data that it needs.
        """
        from slipid.plots.fit import picture

        return picture(self, required(self.data), name)

    def profile(self, path: str, quiet: bool = False) -> Profile:
        """Return the profile likelihood of one free parameter, all others refitted at each point.

        Raises:
            ValueError: the parameter does not exist, is fixed, or is a vector; the message lists
                the parameters that have a profile.
        """
        with Reporter(quiet=quiet) as report:
            report.stage(f"profile of {path}")
            return profile(required(self.problem), required(self.optimum), path)

    def validate(self, runs: Runs) -> Validation:
        """Return the scores of runs predicted open loop by the fit and by simpler slip models.

        The simpler models were fitted to the same runs as the fit itself.

        Raises:
            DataError: a run has a floor or a load set-up that was not identified.
        """
        models = restored(self.config_shape, dict(self.baselines))
        chosen = {floor: one.model for floor, one in self.selection.items()}
        return validation(self.contact, models, runs, self.new_runs(runs), self.seen, chosen)

    @property
    def config_shape(self) -> Geometry:
        """Geometry with the lengths of the config, which the fit may have changed."""
        shape: Geometry = self.space.template.geometry
        if self.calibration is None:
            return shape
        return with_lengths(shape, self.calibration.nominal_radius, self.calibration.nominal_base)

    @property
    def seen(self) -> Robot:
        """The fitted robot with the calibrated pose sensor, by which simpler models are judged."""
        return self.robot if self.calibration is None else self.calibration.seen(self.robot)

    def tracks(self, w: Windows) -> Tracks:
        """Return tracks of whole runs, predicted by the slip model selected on each floor."""
        whole = self.contact.tracks(w)
        out = Tracks(whole.run, np.array(whole.predicted), np.array(whole.measured))
        models = {m.name: m for m in restored(self.config_shape, dict(self.baselines))}
        for name in sorted({one.model for one in self.selection.values()} - {"contact"}):
            mine = [self.selection[floor].model == name for floor in w.surface]
            late = w.at_lag(float(self.seen.camera.lag))
            increments = models[name].increments(late, self.seen)
            own = tracks_from_increments(self.seen, w, increments)
            out.predicted[mine], out.measured[mine] = own.predicted[mine], own.measured[mine]
        return out

    @cached_property
    def trust(self) -> Trust:
        """Trust in the models that were selected on the floors."""
        parameters = self.parameters.values()
        return verdict_of_trust(self.selection, self.converged, parameters, self.suspects)

    def new_runs(self, data: Runs) -> int:
        """Return the number of runs that the fit does not contain."""
        fitted = {sha for _, sha in self.runs}
        return sum(log.sha256 not in fitted for log in data.logs)

    def sample(
        self,
        seed: int = 0,
        draws: int = 400,
        most: int = 400,
        plan: "Plan | None" = None,
        quiet: bool = False,
    ) -> "Posterior":
        """Sample the posterior with several emcee ensembles; needs the extra `posterior`.

        Args:
            seed: seed of all random numbers.
            draws: number of draws kept from each ensemble.
            most: number of blocks after which sampling ends even without convergence.
            plan: settings of the sampler, which replace `seed` and `most`.
            quiet: show no progress.

        Raises:
            MissingExtra: a package is not installed; the message names the command to type.
        """
        from slipid.infer.posterior import blocks

        blocks.require_packages()
        from slipid.infer.posterior import sample

        plan = plan or blocks.Plan(seed=seed, most=most)
        with Reporter(quiet=quiet) as report:
            return sample.sampled(self, plan, draws, None, report)

    def compare(self, question: str = "sectors", parts: int = 6, quiet: bool = False) -> Comparison:
        """Compare slip models by cross-validation: each is refitted and scored on held-out runs.

        Starts, the prior of the lag and the windows remain those of this fit; `slipid compare`
        takes them from the runs that are not held out.

        Args:
            question: grouping of the runs that are held out together: `sectors` of 60 degrees of
                headings, `speeds`, or `random` headings.
            parts: number of folds, at least 2. With 2 folds, each consists of every second sector.
            quiet: show no progress.

        Raises:
            DataError: the question is unknown.
        """
        problem, data = required(self.problem), required(self.data)
        return compared(problem, self.choices, data, question, parts, quiet)

    def design(self, *parameters: str, runs: int = 12) -> "Design":
        """Return the runs to drive next to reduce the intervals of given parameters most.

        If no parameter is given, the runs are chosen for predictions and for all parameters with
        the verdict `weak`.

        Raises:
            DataError: a parameter does not exist or is fixed.
        """
        from slipid.infer.design import proposal
        from slipid.infer.design.scope import Scope

        return proposal.design(Scope(self, parameters=parameters, runs=runs))

    def deploy(self) -> "DeployedRobot":
        """Return the model for the robot, with the intervals of the fit.

        Raises:
            ValueError: the wheels' kinematics have rank below 3.
        """
        from slipid.deploy.deploy import deploy

        return deploy(self)

    def save(self, folder: Path | str) -> None:
        """Write fit.json, its arrays and identified.json, each completely or not at all.

        If the folder has a fit, the files that depend on it, such as robot.json, are deleted.
        """
        from slipid.infer import fit_file

        fit_file.save(self, Path(folder))

    @classmethod
    def load(cls, folder: Path | str) -> "Fit":
        """Read a fit from the files in a folder.

        Raises:
            DataError: a file is absent, damaged, of another version or of another fit.
        """
        from slipid.infer import fit_file

        return fit_file.load(Path(folder))

    @cached_property
    def contact(self) -> ForceBalance:
        """The fitted force balance as a slip model, which predicts runs."""
        shared, extrapolation = self.shared, self.extrapolation
        return ForceBalance(
            self.robot, self.variance, self.covariance, self.space, self.z, shared, extrapolation
        )

    @cached_property
    def robot(self) -> Robot:
        """Robot with every parameter at its fitted or fixed value."""
        return self.space.tree(jnp.asarray(self.z))

    @cached_property
    def parameters(self) -> dict[str, Estimate]:
        """Every parameter, keyed by path, with interval and verdict."""
        volts, flat = self.channels.voltage, members(self.flat)
        known = self.z, self.covariance, volts, flat, self.chain
        found = estimates(self.verdict_space, self.choices, *known)
        return doubted(marked({e.path: e for e in found}, self.disputes), self.held_out)

    @cached_property
    def verdict_space(self) -> Space:
        """Search space with the fitted prior std of load biases.

        Verdicts compare posterior stds with the prior stds of this space.
        """
        if POOLED not in self.variance:
            return self.space
        return self.space.with_pooled(float(np.sqrt(self.variance[POOLED])))

    @cached_property
    def load_comparisons(self) -> tuple[LoadComparison, ...]:
        """Comparison of the wheel loads of every pair of floors, the most sensitive first."""
        return load_comparisons(self.verdict_space, self.z, self.covariance)

    @property
    def disputes(self) -> dict[tuple[str, str], float]:
        """Difference of wheel loads [standard error], keyed by each pair of disagreeing floors.

        The largest difference comes first.
        """
        found = {c.floors: c.standard_errors for c in self.load_comparisons if c.disputed}
        return dict(sorted(found.items(), key=lambda pair: -pair[1]))

    @cached_property
    def flat(self) -> tuple[FlatDirection, ...]:
        """Flat directions of the likelihood, from the covariance without shared effects.

        Shared effects widen intervals but do not make a direction flat.
        """
        has, sideways = self.channels, self.robot.geometry.determines_twist
        return flat_directions(
            self.space, self.laplace, has.current, has.voltage, self.validity, sideways
        )

    @cached_property
    def derived(self) -> dict[str, Estimate]:
        """Ratios of parameters, keyed by path; one may be identified even if its parts are not."""
        known = self.z, self.covariance, self.channels.voltage
        found = derived(self.space, *known, chain=self.chain)
        return doubted({e.path: e for e in found}, self.held_out)

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings about the fit and its parameters, one sentence each, the gravest first."""
        found = [] if self.converged else [f"the fit did not converge: {self.reason}"]
        if self.refused is not None:
            found.append(str(self.refused["reason"]))
        found += [
            f"the wheel loads estimated on {one} and on {other} differ by {sigma:.1f} standard "
            "errors of their noise: the contact law is incomplete; the intervals include this "
            "difference"
            for (one, other), sigma in self.disputes.items()
        ]
        found += [
            f"{e.path} ended at its bound ({e.value:.3g} {e.unit})"
            for e in self.parameters.values()
            if e.verdict == "at_bound" and isinstance(e.value, float)
        ]
        found += [
            f"{e.path} is {abs(e.pull):.1f} prior stds away from its prior mean: the prior is "
            "wrong, or the model is incomplete"
            for e in self.parameters.values()
            if e.pull is not None and abs(e.pull) > CONFLICT_STDS and e.verdict != "at_bound"
        ]
        if self.held_out is not None and self.held_out.worse_than:
            found.append(
                "least squares predict held-out motor currents from voltages better than the "
                "fitted motor, so that resistance and back-EMF are at most weak: the model lacks "
                "something that acts in the motors"
            )
        return (*found, *sentences(self.flat))

    @property
    def data_hash(self) -> str:
        return hash_of(self.runs)

    def draws(self, count: int, seed: int = 0) -> Float[np.ndarray, "draw free"]:
        """Return draws of the short chain, or of the Laplace approximation without one."""
        if self.chain is None:
            return draws(self.z, self.covariance, count, seed)
        return some_of(self.chain.flat, count, seed)


def required(evidence: Evidence | None) -> Evidence:
    """Return an attribute of a fit; raise `ValueError` if it is None, as after `Fit.load`."""
    if evidence is None:
        raise ValueError(
            "this fit was loaded from its files, which contain neither the runs nor their "
            "likelihood; expected a fit that was just made by `fit` from runs"
        )
    return evidence


def draws(z: Search, covariance: Square, count: int, seed: int) -> Float[np.ndarray, "draw free"]:
    """Return draws of the Gaussian N(z, covariance) in the search space."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(covariance)
    return z + rng.standard_normal((count, len(root))) @ root.T
