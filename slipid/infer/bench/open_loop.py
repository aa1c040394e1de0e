"""Fit of a motor's open-loop simulation to its measured current and speed.

The residuals of a channel have Student's t distribution with 4 degrees of freedom. The scales of
both channels and the weights of the residuals are updated with every Levenberg-Marquardt step in
the search space. Derivatives are exact. A simulation is continuous between segments: the starts of
the segments are solved for, by Newton's method where derivatives are known.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from slipid.infer.bench.motor import BenchMotor
from slipid.infer.bench.rows import Rows
from slipid.infer.bench.simulation import NAMES, derivatives, simulated
from slipid.search_space import Space

DEGREES = 4.0
"""Degrees of freedom of Student's t."""
MOST_ROUNDS = 80
"""Largest number of steps of a fit."""
SETTLED = 0.02
"""Usual decrease of the loss below which a fit has converged, that of a fifth of a std."""
LONGEST_STEP = 1.0
"""Largest change of a coordinate of the search space in one step, in prior stds."""
CONTINUOUS = 1e-6
"""Largest jump between segments, relative to the range of a channel."""
LEAST_SCALE = 0.05
"""Smallest first scale of residuals, relative to their root mean square."""
LATEST = 3.0
"""Longest delay of a speed [row]."""
MOST_SCALINGS, SAME_SCALE = 100, 1e-5
"""Largest number of updates of the scales, and relative change below which they are settled."""
MOST_PASSES = 80
"""Largest number of simulations until the states are continuous."""

Values = Float[np.ndarray, " parameter"]
"""Parameters in the order `NAMES` [SI]."""
Channels = Float[np.ndarray, "channel segment step"]
"""An array of two channels, the current and the speed."""
RowWeights = Float[np.ndarray, "segment step"]
Starts = Float[np.ndarray, "segment 2"]


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """Simulation of all rows with given parameters.

    Attributes:
        values: parameters.
        start: states at the starts of the segments.
        states: states of all rows.
        readings: predicted current [A] and speed [rad/s].
    """

    values: Values
    start: Starts
    states: Float[np.ndarray, "segment step 2"]
    readings: Channels

    @property
    def motor(self) -> BenchMotor:
        return BenchMotor(*self.values)


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Derivatives by parameters, whether they are free or not [SI].

    Attributes:
        readings: of predicted readings.
        start: of the states at the starts of the segments.
        carry: of the states at the ends of segments, by those at their starts.
    """

    readings: Float[np.ndarray, "parameter channel segment step"]
    start: Float[np.ndarray, "segment 2 parameter"]
    carry: Float[np.ndarray, "segment 2 2"]


def values_of(motor: BenchMotor) -> Values:
    """Return the parameters of a motor."""
    return np.array([float(getattr(motor, name)) for name in NAMES])


def open_loop(
    rows: Rows,
    values: Values,
    start: Starts,
    carry: Float[np.ndarray, "segment 2 2"] | None = None,
    passes: int = MOST_PASSES,
) -> OpenLoop:
    """Return a simulation of all rows that is continuous between segments.

    Args:
        rows: rows with their voltages.
        values: parameters.
        start: approximate states at the starts of the segments.
        carry: approximate derivatives of the ends of segments by their starts, None if unknown.
        passes: largest number of simulations until the states are continuous.
    """
    size = np.maximum(np.abs(rows.start).max(axis=0), 1e-9)
    for _ in range(passes):
        states = simulated(values, start, rows.inputs)
        jump = rows.continued(states[:, -1], rows.start) - start
        if np.abs(jump / size).max() < CONTINUOUS or not np.isfinite(jump).all():
            break
        if carry is not None:
            for k in np.flatnonzero(~rows.first):
                jump[k] += carry[k - 1] @ jump[k - 1]
        start = start + jump
    return OpenLoop(values, start, states, _readings(rows, values, start, states))


def with_speed_delay(rows: Rows, at: OpenLoop, delay: float) -> OpenLoop:
    """Return a simulation with another delay of the speed [s]."""
    values = at.values.copy()
    values[NAMES.index("speed_delay")] = delay
    return replace(at, values=values, readings=_readings(rows, values, at.start, at.states))


def _readings(
    rows: Rows, values: Values, start: Starts, states: Float[np.ndarray, "segment step 2"]
) -> Channels:
    """Return predicted readings of the ammeter and of the speed."""
    current = states[..., 0]
    amps = current if rows.signed else np.abs(current)
    speed, _ = _late(rows, values, states[..., 1], start[:, 1])
    return np.stack([amps + _value(values, "current_offset"), speed])


def _late(
    rows: Rows,
    values: Values,
    speed: Float[np.ndarray, "segment step *n"],
    start: Float[np.ndarray, "segment *n"],
) -> tuple[Float[np.ndarray, "segment step *n"], Float[np.ndarray, "segment step *n"]]:
    """Return late speeds, interpolated between rows, and their derivative by the delay."""
    late = float(np.clip(_value(values, "speed_delay") / rows.period, -LATEST, LATEST))
    whole = int(np.floor(late))
    new, old = (rows.moved(speed, start, k) for k in (whole, whole + 1))
    slope = old - new
    return new + (late - whole) * slope, slope / rows.period


def _value(values: Values, name: str) -> float:
    return float(values[NAMES.index(name)])


def _slopes(rows: Rows, at: OpenLoop) -> _Slopes:
    """Return the derivatives of a simulation that is continuous between segments."""
    own = derivatives(at.values, at.start, at.states, rows.inputs)
    count = len(NAMES)
    by_values, by_start = own[..., :count], own[..., count:]
    starts = np.zeros((len(own), 2, count))
    for k in np.flatnonzero(~rows.first):
        starts[k] = by_values[k - 1, -1] + by_start[k - 1, -1] @ starts[k - 1]
    states = by_values + by_start @ starts[:, None]
    current, speed = states[..., 0, :], states[..., 1, :]
    if not rows.signed:
        current = current * np.sign(at.states[..., 0, None])
    speed, _ = _late(rows, at.values, speed, starts[:, 1])
    out = np.moveaxis(np.stack([current, speed]), -1, 0)
    out[NAMES.index("current_offset"), 0] += 1.0
    _, by_delay = _late(rows, at.values, at.states[..., 1], at.start[:, 1])
    out[NAMES.index("speed_delay"), 1] += by_delay
    return _Slopes(out, starts, by_start[:, -1])


@dataclass(frozen=True, eq=False)
class OpenLoopFit:
    """Fit of a simulation to readings.

    Attributes:
        rows: rows.
        space: free parameters.
        z: search vector at the optimum.
        at: simulation at the optimum.
        slopes: derivatives of predicted readings by the search vector.
        by_values: those by all parameters [SI].
        scales: scale of each channel's residuals [A], [rad/s].
        weights: weight of each residual, in the normal equations of residuals over scales.
        loss: negative log-posterior, without constants; infinite if it is not a number.
        converged: True if the parameters settled.
        rounds: number of steps.
    """

    rows: Rows
    space: Space
    z: Float[np.ndarray, " free"]
    at: OpenLoop
    slopes: Float[np.ndarray, "free channel segment step"]
    by_values: Float[np.ndarray, "parameter channel segment step"]
    scales: Float[np.ndarray, " channel"]
    weights: Channels
    loss: float
    converged: bool
    rounds: int

    @property
    def residuals(self) -> Channels:
        """Measured less predicted readings [A], [rad/s]."""
        return _measured(self.rows) - self.at.readings

    @property
    def terms(self) -> Float[np.ndarray, "segment step"]:
        """Negative log-likelihood of each row, without constants."""
        squares = (self.residuals / self.scales[:, None, None]) ** 2
        use = self.weights * (DEGREES + squares) / (DEGREES + 1)
        density = (DEGREES + 1) / 2 * np.log1p(squares / DEGREES)
        return np.asarray((use * (density + np.log(self.scales)[:, None, None])).sum(axis=0))

    def slope(self, name: str) -> Channels:
        """Return the derivative of the readings by a parameter that need not be free [SI]."""
        return self.by_values[NAMES.index(name)]


def _measured(rows: Rows) -> Channels:
    return np.stack([rows.current, rows.speed])


def fit_open_loop(
    rows: Rows,
    space: Space,
    z: Float[np.ndarray, " free"],
    weight: RowWeights | None = None,
    rounds: int = MOST_ROUNDS,
    settled: float = SETTLED,
) -> OpenLoopFit:
    """Return the fit of the free parameters to the rows.

    Args:
        rows: rows.
        space: free parameters with their priors.
        z: search vector at the start.
        weight: weight of each row, 1 by default; rows of weight 0 are simulated only.
        rounds: largest number of steps.
        settled: decrease of the loss in a step below which the fit has converged.
    """
    use = (rows.used if weight is None else weight * rows.used)[None] * np.ones((2, 1, 1))
    # A current that drives the motor is no reading.
    use[0] *= rows.has_current and rows.inputs.driven > 0
    search = _Search(rows, space, use, z)
    while search.rounds < rounds and not search.ended:
        search.step(settled)
    search.settle_scales()
    residuals = _measured(rows) - search.at.readings
    squares = (residuals / search.scales[:, None, None]) ** 2
    constant = float(use.sum((1, 2)) @ np.log(search.scales))
    loss = search.loss(search.at, search.z) + constant
    ended = search.ended and bool(np.isfinite(loss))
    return OpenLoopFit(
        rows=rows,
        space=space,
        z=search.z,
        at=search.at,
        slopes=search.by_search,
        by_values=search.slopes.readings,
        scales=search.scales,
        weights=use * (DEGREES + 1) / (DEGREES + squares),
        loss=loss if np.isfinite(loss) else np.inf,
        converged=ended,
        rounds=search.rounds,
    )


class _Coordinates:
    """The map from a search vector to the parameters of a motor, all of which are scalars."""

    def __init__(self, space: Space):
        self._template = values_of(space.template.motor)
        self._declared = [e.declaration for e in space.free]
        self.at = [NAMES.index(e.path.removeprefix("motor.")) for e in space.free]

    def values(self, z: Float[np.ndarray, " free"]) -> Values:
        """Return the parameters at a search vector."""
        out = self._template.copy()
        for k, declared, x in zip(self.at, self._declared, z, strict=True):
            out[k] = declared.to_si(np.array([x]))[0]
        return out

    def rates(self, values: Values) -> Float[np.ndarray, " free"]:
        """Return the derivative of each free parameter by its coordinate."""
        some = zip(self.at, self._declared, strict=True)
        return np.array([declared.slope(values[k]) for k, declared in some])


class _Search:
    """State of a fit by Levenberg and Marquardt.

    Attributes:
        z: search vector.
        at: simulation there.
        slopes: derivatives there.
        scales: scales of both channels' residuals.
        ended: True if the last step did not decrease the loss noticeably.
        rounds: number of steps.
    """

    def __init__(self, rows: Rows, space: Space, use: Channels, z: Float[np.ndarray, " free"]):
        self._rows, self._space, self._use = rows, space, use
        self._map = _Coordinates(space)
        self.z, self.at = z, open_loop(rows, self._map.values(z), rows.start)
        self.rounds, self.ended, self._damping = 0, False, 1e-3
        self.scales = _first_scales(self._residuals, use)
        self.slopes = _slopes(rows, self.at)

    @property
    def _residuals(self) -> Channels:
        return _measured(self._rows) - self.at.readings

    @property
    def by_search(self) -> Float[np.ndarray, "free channel segment step"]:
        """Derivatives of readings by the search vector."""
        rates = self._map.rates(self.at.values)
        return self.slopes.readings[self._map.at] * rates[:, None, None, None]

    def loss(self, at: OpenLoop, z: Float[np.ndarray, " free"]) -> float:
        """Return the negative log-posterior at the present scales."""
        residuals = _measured(self._rows) - at.readings
        squares = (residuals / self.scales[:, None, None]) ** 2
        data = (DEGREES + 1) / 2 * float((self._use * np.log1p(squares / DEGREES)).sum())
        prior = (z - self._space.prior_mean) / self._space.prior_std
        return data + float(prior @ prior) / 2

    def step(self, settled: float) -> None:
        """Make a step of Levenberg and Marquardt, and update scales and derivatives.

        If its decrease of the loss is below `settled`, the search has ended.
        """
        self.rounds += 1
        self.scales = _next_scales(self._residuals, self._use, self.scales)
        before = self.loss(self.at, self.z)
        if not np.isfinite(before):
            self.ended = True
            return
        gradient, hessian = self._normal()
        while True:
            scaled = hessian + self._damping * np.diag(np.diag(hessian))
            step = np.linalg.solve(scaled, gradient)
            longest = float(np.max(np.abs(step / self._space.prior_std)))
            step /= max(1.0, longest / LONGEST_STEP)
            expected = float(gradient @ step - step @ hessian @ step / 2)
            values = self._map.values(self.z + step)
            start = self.at.start + self.slopes.start @ (values - self.at.values)
            new = open_loop(self._rows, values, start, self.slopes.carry, passes=4)
            decrease = before - self.loss(new, self.z + step)
            if decrease >= -1e-9 * abs(before):
                break
            if expected < settled or self._damping > 1e8:
                self.ended = True
                return
            self._damping *= 8
        self._damping = max(self._damping / 6, 1e-9)
        self.z, self.at, self.slopes = self.z + step, new, _slopes(self._rows, new)
        self.ended = decrease < settled and expected < settled

    def settle_scales(self) -> None:
        """Update the scales until they are the likeliest, so that losses of fits compare."""
        for _ in range(MOST_SCALINGS):
            old = self.scales
            self.scales = _next_scales(self._residuals, self._use, old)
            if not (np.abs(self.scales / old - 1) > SAME_SCALE).any():
                return

    def _normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient of the log-posterior and its negative Gauss-Newton Hessian."""
        space, residuals, slopes = self._space, self._residuals, self.by_search
        gradient = (space.prior_mean - self.z) / space.prior_std**2
        hessian = np.diag(1 / space.prior_std**2)
        for k, s in enumerate(self.scales):
            r = residuals[k].ravel() / s
            w = self._use[k].ravel() * (DEGREES + 1) / (DEGREES + r**2)
            j = slopes[:, k].reshape(space.size, -1) / s
            gradient = gradient + j @ (w * r)
            hessian = hessian + (j * w) @ j.T
        return gradient, hessian


def _first_scales(residuals: Channels, use: Channels) -> Float[np.ndarray, " channel"]:
    """Return robust scales of both channels, 1 for a channel that is not used.

    They are not 0 if most residuals are, as those of a shaft that rests most of the time.
    """
    out = np.ones(2)
    for k, (r, w) in enumerate(zip(residuals, use, strict=True)):
        if (w > 0).any():
            size = np.abs(r[w > 0])
            usual, mean = 1.4826 * float(np.median(size)), float(np.sqrt(np.mean(size**2)))
            out[k] = max(usual, LEAST_SCALE * mean, 1e-12)
    return out


def _next_scales(
    residuals: Channels, use: Channels, scales: Float[np.ndarray, " channel"]
) -> Float[np.ndarray, " channel"]:
    """Return the scales after one step of expectation and maximisation."""
    out = scales.copy()
    for k, (r, w) in enumerate(zip(residuals, use, strict=True)):
        if (w > 0).any():
            mean = (DEGREES + 1) * r**2 / (DEGREES + (r / scales[k]) ** 2)
            out[k] = max(float(np.sqrt((w * mean).sum() / w.sum())), 1e-12)
    return out
