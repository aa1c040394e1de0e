"""Fit of one motor: its open-loop simulation, the form of its model, and its uncertainty.

The form of the voltage between rows (held, straight, or straight with jumps) is the likeliest one
unless the user gives it. The model has a voltage drop of the brushes. A drift of the resistance
with time is added only if its estimate is significant.

A drop of the brushes, one that grows with the logarithm of the current, a resistance that falls
with current, and a drop with a falling resistance explain similar logs. All are fitted, and so are
the likely forms of the voltage between rows. If the log does not distinguish a fit from the chosen
one (Vuong 1989), the intervals of resistance and back-EMF include those of a mixture of both. Its
weight is the probability that it is more likely than the chosen one, which itself has weight 1,
similar to the pseudo-BMA+ weights of Yao et al. (2018).
"""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from slipid.infer.bench.held_out import held_out
from slipid.infer.bench.least_squares import least_squares
from slipid.infer.bench.motor import BenchMotor, BenchRecord, BenchRoot, noise
from slipid.infer.bench.open_loop import (
    SETTLED,
    Channels,
    OpenLoop,
    OpenLoopFit,
    fit_open_loop,
    open_loop,
    values_of,
    with_speed_delay,
)
from slipid.infer.bench.rows import Between, Rows, excerpt, rows_of
from slipid.infer.bench.uncertainty import (
    Uncertainty,
    advantage,
    mixture_quantiles,
    significance,
    uncertainty,
)
from slipid.infer.held_out import HeldOut
from slipid.search_space import Choice, Space
from slipid.support.errors import DataError

Contacts = Literal["falling", "logarithmic", "both"]
"""Another model of the contacts than a drop of the brushes: a resistance that falls with current, a
drop that grows with the logarithm of the current, or a drop and a falling resistance."""
FORMS: tuple[Between, ...] = ("held", "straight", "jumps")
"""Forms of the voltage between rows that are tried."""
WHOLE_DELAYS = (-1.0, 0.0, 1.0)
"""Delays of a voltage that is held or straight between rows [row]."""
DELAYS_OF_JUMPS = (-1.5, -0.8, -0.5, -0.2, 0.5)
"""Delays of jumps between rows from which fits may start [row]."""
DELAYS_OF_SPEED = (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5)
"""Delays of a speed from which fits may start [row]."""
JUMPS_COST = 15.0
"""Log-likelihood that jumps between rows have to gain, since they fit noise, too."""
BOTH_COST = 10.0
"""Log-likelihood that a drop and a falling resistance have to gain over a drop alone."""
SAME_NUMBERS = 0.002
"""Relative difference below which resistances and back-EMFs of two forms are the same."""
SIGNIFICANT_STDS = 4.0
"""Estimate of an effect above which it is added to the model [std]."""
UNLIKELY_STDS, LIKELY_STDS = 2.0, 4.0
"""Advantage of the chosen fit above which another one is not considered, and advantage of another
model of the contacts above which it is chosen [std].

Some rows may mislead, so that a form of the voltage is excluded by the larger advantage there."""
DROP_SHARE = 0.01
"""Voltage of the brushes over that of the winding below which all models of them agree."""
SMALL_PART = 0.2
"""Part of a drop of the brushes from which a fit starts that has a falling resistance, too."""
LOGARITHMIC_TAIL = 0.99
"""Part of the brush drop that grows with the logarithm of the current, where nearly all does."""
LARGEST_DRIFT = 0.1
"""Usual size of a drift of the resistance in a record [1]."""
LARGEST_FALL = 0.5
"""Largest relative fall of the resistance from which a fit starts."""
SMALL_CURRENT = 0.1
"""Smallest current of the range of a falling resistance, relative to the largest current."""
LARGE_CURRENT = 0.75
"""Current at which what a drop still rises may be resistance, relative to the largest current."""
TIME_CONSTANT_S = 5e-4
"""Usual electrical time constant L_a / R [s]."""
USUAL_DROP_V, DROP_OF_SUPPLY = 0.3, 0.03
"""Usual voltage drop of the brushes, and its largest share of the largest voltage [V], [1]."""
LARGEST_OFFSET = 0.3
"""Largest offset of the voltage from which a fit starts, relative to the largest voltage."""
DECIDING_ROWS = 3000
"""Number of rows from which the form of the model is decided."""
WARM_UP = 0.2
"""Part of an excerpt, at its start, in which the simulation forgets its inexact start."""
ROUGHLY_SETTLED = 0.5
"""Decrease of the loss below which a fit that decides on a form, or to a part of the rows, ends."""
FOLD_ROUNDS = 8
"""Largest number of steps of a fit to a part of the rows."""
_NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class MotorFit:
    """Fit of one motor.

    Attributes:
        label: label of the motor, "" for a single one.
        records: runs of the motor.
        choices: user's choices.
        fit: fit of the selected model.
        between: form of the voltage between rows.
        uncertainty: uncertainty of the search vector.
        ranges: intervals of parameters that more than one model explains, or that change in the
            log, keyed by path [SI].
        other_contacts: other models of the contacts that are about as likely.
        other_forms: forms of the voltage between rows that are about as likely, with other numbers.
        held_out: errors on rows that were not used, None without voltages.
        rounds: number of steps of all fits.
    """

    label: str
    records: tuple[BenchRecord, ...]
    choices: tuple[Choice, ...]
    fit: OpenLoopFit
    between: Between
    uncertainty: Uncertainty
    ranges: Mapping[str, tuple[float, float]]
    other_contacts: tuple[Contacts, ...]
    other_forms: tuple[Between, ...]
    held_out: HeldOut | None
    rounds: int

    @property
    def rows(self) -> Rows:
        return self.fit.rows

    @property
    def space(self) -> Space:
        return self.fit.space

    @property
    def z(self) -> Float[np.ndarray, " free"]:
        return self.fit.z

    @property
    def covariance(self) -> Float[np.ndarray, "free free"]:
        return self.uncertainty.covariance

    @property
    def motor(self) -> BenchMotor:
        """Motor with the fitted parameters."""
        return self.fit.at.motor

    @property
    def converged(self) -> bool:
        return self.fit.converged and bool(np.isfinite(self.z).all())

    @property
    def reason(self) -> str:
        """Sentence on how the fit ended."""
        if self.converged:
            return f"the likelihood did not increase any more after {self.rounds} steps"
        return f"{self.rounds} steps without convergence"

    @property
    def noise(self) -> dict[str, float | None]:
        """Std of the white noise of each channel, None for a channel that was not logged."""
        out: dict[str, float | None] = {}
        for channel in ("voltage", "current", "speed"):
            signals = [getattr(r, channel) for r in self.records]
            out[channel] = None if signals[0] is None else noise(signals)
        return out

    @property
    def has_voltage(self) -> bool:
        return self.records[0].voltage is not None

    @property
    def has_current(self) -> bool:
        return self.records[0].current is not None

    @property
    def period(self) -> float:
        """Median time between rows [s]."""
        return self.rows.period


def fit_motor(
    records: Sequence[BenchRecord],
    choices: Sequence[Choice] = (),
    label: str = "",
    between: Between | None = None,
) -> MotorFit:
    """Return the fit of one motor to its records.

    Args:
        records: records, all with the same channels.
        choices: user's choices.
        label: label of the motor.
        between: form of the voltage between rows, None for the likeliest.

    Raises:
        DataError: no simulation of the motor is finite.
    """
    some = excerpt(records, DECIDING_ROWS)
    model = _BenchModel(rows_of(some, WARM_UP if len(some) > len(records) else 0.0), tuple(choices))
    rows = rows_of(records)
    some_forms = model.with_forms(FORMS if between is None else (between,))
    # All rows may decide between forms that few rows do not.
    formed = [_Formed(one.form, model.of_all(rows, one)) for one in some_forms]
    likeliest = min(formed, key=lambda one: one.loss)
    best = likeliest.fit
    if not np.isfinite(best.loss):
        raise DataError(
            f"{records[0].name}: no simulation of the motor follows this log; expected a log with "
            "several speeds, or start values of resistance and back-EMF in a config"
        )
    best = model.extended(best)
    contacts = model.with_other_contacts(best)
    # A drop that grows with the logarithm is a special case of the first one.
    free = [best, *(one for name, one in contacts.items() if name != "logarithmic")]
    leads = [advantage(one, best) for one in free]
    chosen = free[int(np.argmax(leads))] if max(leads) > LIKELY_STDS else best
    likely: dict[Contacts, OpenLoopFit] = {
        name: fit
        for name, fit in contacts.items()
        if fit is not chosen and _is_likely_beside(chosen, fit)
    }
    others = [
        one for one in formed if _is_likely_beside(chosen, one.fit) and one.differs(likeliest.fit)
    ]
    rivals = [chosen, *likely.values(), *(other.fit for other in others)]
    known = [uncertainty(fit) for fit in rivals]
    weights = [1.0, *(float(ndtr(advantage(fit, chosen))) for fit in rivals[1:])]
    return MotorFit(
        label=label,
        records=tuple(records),
        choices=tuple(choices),
        fit=chosen,
        between=likeliest.form,
        uncertainty=known[0],
        ranges=_ranges(rivals, known, weights),
        other_contacts=tuple(likely),
        other_forms=tuple(other.form for other in others),
        held_out=_held_out(chosen) if records[0].voltage is not None else None,
        rounds=model.rounds,
    )


@dataclass(frozen=True, eq=False)
class _Formed:
    """A fit with one form of the voltage between rows.

    Attributes:
        form: form.
        fit: fit.
    """

    form: Between
    fit: OpenLoopFit

    @property
    def loss(self) -> float:
        """Loss of the fit, and what jumps have to pay."""
        return self.fit.loss + JUMPS_COST * (self.form == "jumps")

    def differs(self, best: OpenLoopFit) -> bool:
        """Return True if another fit has another resistance or back-EMF."""
        mine, other = self.fit.at.motor, best.at.motor
        ratios = (mine.resistance / other.resistance, mine.back_emf / other.back_emf)
        return max(abs(float(ratio) - 1) for ratio in ratios) > SAME_NUMBERS


class _BenchModel:
    """The model of a motor, which grows with what its rows show.

    Attributes:
        rows: rows.
        is_full: True if voltage and current were logged.
        rounds: number of steps of all fits.
    """

    def __init__(self, rows: Rows, choices: tuple[Choice, ...]):
        self.rows, self.rounds = rows, 0
        self._choices = choices
        self.is_full = rows.has_current and bool(rows.inputs.driven)
        used = rows.used
        self._amps = max(float(np.abs(rows.current[used]).max()), 1e-9)
        self._volts = max(float(np.abs(rows.voltage[used]).max()), 1e-9)
        self._start = self._first()

    def _first(self) -> BenchMotor:
        """Return a motor from least squares, and with usual values of what they do not estimate."""
        m = least_squares(self.rows, with_offset=True)
        # At one speed, an offset cannot be distinguished from the voltage.
        if abs(float(m.voltage_offset)) > LARGEST_OFFSET * self._volts:
            m = least_squares(self.rows, with_offset=False)
        # Rows do not show a motor that follows within a row.
        least = self.rows.period * float(m.back_emf) ** 2 / float(m.resistance)
        return eqx.tree_at(
            lambda t: [
                t.rotor_inertia,
                t.inductance,
                t.brush_drop,
                t.brush_current,
                t.stribeck_friction,
            ],
            m,
            [
                np.asarray(max(float(m.rotor_inertia), least)),
                np.asarray(TIME_CONSTANT_S * float(m.resistance)),
                np.asarray(self._usual_drop),
                np.asarray(0.1 * self._amps),
                np.asarray(0.1 * float(m.coulomb_friction)),
            ],
        )

    @property
    def _usual_drop(self) -> float:
        return min(USUAL_DROP_V, DROP_OF_SUPPLY * self._volts)

    def space(self, more: Sequence[Choice] = ()) -> Space:
        """Return the search space with priors scaled to the motor, and with choices."""
        drop, row = self._usual_drop, self.rows.period
        slow = TIME_CONSTANT_S * float(self._start.resistance)
        dry = float(self._start.coulomb_friction)
        usual = [
            Choice("motor.current_offset", prior_mean=0.0, prior_std=0.1 * self._amps),
            Choice("motor.voltage_offset", prior_mean=0.0, prior_std=0.03 * self._volts),
            Choice("motor.inductance", prior_mean=slow, prior_std=2 * slow),
            Choice("motor.brush_drop", prior_mean=drop, prior_std=1.2 * drop),
            Choice("motor.brush_current", prior_mean=0.1 * self._amps, prior_std=0.1 * self._amps),
            Choice("motor.fall_current", start=0.3 * self._amps),
            Choice("motor.reference_current", start=self._typical_current),
            Choice("motor.stribeck_friction", prior_mean=0.2 * dry, prior_std=0.3 * dry),
            Choice("motor.voltage_delay", prior_mean=0.0, prior_std=row),
            Choice("motor.speed_delay", prior_mean=0.0, prior_std=row),
        ]
        return Space(BenchRoot(BenchMotor()), [*usual, *self._reduced(), *more, *self._choices])

    @property
    def _typical_current(self) -> float:
        return float(np.sqrt(np.mean(self.rows.current[self.rows.used] ** 2))) or 1.0

    def _reduced(self) -> list[Choice]:
        """Return choices that fix what a missing channel leaves undetermined."""
        if self.is_full:
            return []
        if self.rows.has_current:
            return [Choice("motor.voltage_delay", fixed=0.0)]
        fixed = {
            "resistance": 1.0,
            "inductance": _NOTHING,
            "brush_drop": _NOTHING,
            "stribeck_friction": _NOTHING,
            "viscous_friction": 1e-12,
            "current_offset": 0.0,
            "speed_delay": 0.0,
        }
        unused = ("brush_current", "brush_shape", "brush_tail", "stribeck_speed")
        return [
            *(Choice(f"motor.{name}", fixed=value) for name, value in fixed.items()),
            *(Choice(f"motor.{name}", free=False) for name in unused),
        ]

    def fitted(
        self, rows: Rows, space: Space, start: BenchMotor, settled: float = SETTLED
    ) -> OpenLoopFit:
        """Return a fit that starts from a motor."""
        found = fit_open_loop(rows, space, space.vector(BenchRoot(start)), settled=settled)
        self.rounds += found.rounds
        return found

    def with_forms(self, forms: Sequence[Between]) -> list["_Formed"]:
        """Return fits with forms of the voltage between rows, of which the first is the likeliest.

        The others are those that are not clearly less likely. Voltages that are held or straight
        arrive whole rows late, so that their delay is fixed; that of jumps between rows is fitted,
        and has to pay for it.
        """
        space = self.space()
        # Start values and priors from the user replace the estimated start values.
        z = space.vector(BenchRoot(self._start))
        started = [c.pattern for c in self._choices if (c.start, c.prior_mean) != (None, None)]
        given = space.where(lambda e: any(fnmatch.fnmatchcase(e.path, p) for p in started))
        motor = space.tree(np.where(given, space.start, z)).motor
        found = []
        for form in forms if self.rows.inputs.driven else forms[-1:]:
            rows = self.rows.between(form)
            fits = [
                self.fitted(rows, self._with_delay(form, start), start, ROUGHLY_SETTLED)
                for start in self._aligned(rows, form, motor)
            ]
            found.append(_Formed(form, min(fits, key=lambda fit: fit.loss)))
        best = min(found, key=lambda one: one.loss)
        others = [one for one in found if one is not best]
        return [best, *(x for x in others if _is_likely_beside(best.fit, x.fit, LIKELY_STDS))]

    def of_all(self, rows: Rows, one: "_Formed") -> OpenLoopFit:
        """Return the fit with the form of another one, but to all rows."""
        return self.fitted(rows.between(one.form), one.fit.space, one.fit.at.motor)

    def _with_delay(self, form: Between, start: BenchMotor) -> Space:
        """Return the search space for a form, with the delay of `start` unless it has jumps."""
        if form == "jumps" or not self.is_full:
            return self.space()
        return self.space([Choice("motor.voltage_delay", fixed=float(start.voltage_delay))])

    def _aligned(self, rows: Rows, form: Between, motor: BenchMotor) -> list[BenchMotor]:
        """Return motors from which to fit a form, with the likeliest delay of the speed.

        Every whole delay of the voltage is tried, but only the likeliest one of jumps.
        """
        if not rows.inputs.driven:
            return [motor]
        found = []
        for delay in DELAYS_OF_JUMPS if form == "jumps" else WHOLE_DELAYS:
            at = open_loop(rows, values_of(_delayed(motor, delay, rows)), rows.start, passes=16)
            late = DELAYS_OF_SPEED if rows.has_current else (0.0,)
            moved = [with_speed_delay(rows, at, k * rows.period) for k in late]
            found.append(min(moved, key=lambda m: _roughly(rows, m)))
        if form == "jumps" or not self.is_full:
            found = [min(found, key=lambda m: _roughly(rows, m))]
        return [m.motor for m in found]

    def extended(self, fit: OpenLoopFit) -> OpenLoopFit:
        """Return the fit of the model with the effects that its rows show."""
        if not self.is_full:
            return fit
        if abs(significance(fit, "resistance_drift")) < SIGNIFICANT_STDS:
            return fit
        space = self.space([*_fixed_delay(fit), _drift(fit.rows)])
        found = self.fitted(fit.rows, space, fit.at.motor)
        return min(fit, found, key=lambda f: f.loss)

    def with_other_contacts(self, fit: OpenLoopFit) -> dict[Contacts, OpenLoopFit]:
        """Return fits with other models of the contacts than the drop of the brushes of a fit.

        There are none if the drop is negligible, or chosen by the user.
        """
        m = fit.at.motor
        share = float(m.brush_drop) / (float(m.resistance) * self._amps)
        if self._is_chosen("motor.brush_drop") or not self.is_full or share < DROP_SHARE:
            return {}
        falling = self._with_falling_resistance(fit)
        found: dict[Contacts, OpenLoopFit] = {"falling": falling}
        if not self._is_chosen("motor.brush_tail"):
            found["logarithmic"] = self._with_logarithmic_drop(fit)
        both = self._with_both(fit, falling) if np.isfinite(falling.loss) else falling
        if both.loss < fit.loss - BOTH_COST:
            found["both"] = both
        return {name: one for name, one in found.items() if np.isfinite(one.loss)}

    def _is_chosen(self, path: str) -> bool:
        """Return True if the user has a choice for a parameter."""
        return any(fnmatch.fnmatchcase(path, c.pattern) for c in self._choices)

    def _with_falling_resistance(self, fit: OpenLoopFit) -> OpenLoopFit:
        """Return a fit with a falling resistance in place of the drop of the brushes."""
        space = self._like(
            fit,
            Choice("motor.brush_drop", fixed=_NOTHING),
            Choice("motor.brush_current", free=False),
            Choice("motor.brush_shape", free=False),
            Choice("motor.brush_tail", free=False),
            Choice("motor.resistance_fall", free=True),
            Choice("motor.fall_current", free=True),
        )
        # The resistance at the typical current has the same voltage as with the drop.
        m = fit.at.motor
        resistance = float(m.resistance) + float(m.brush_drop) / self._typical_current
        fall = min(float(m.brush_drop) / self._typical_current / resistance, LARGEST_FALL)
        start = eqx.tree_at(
            lambda t: [t.resistance, t.resistance_fall, t.brush_drop],
            m,
            [np.asarray(resistance), np.asarray(fall), np.asarray(_NOTHING)],
        )
        return self.fitted(fit.rows, space, start)

    def _with_both(self, fit: OpenLoopFit, falling: OpenLoopFit) -> OpenLoopFit:
        """Return a fit with a drop of the brushes and a falling resistance.

        It starts from the fit with a falling resistance, and a small part of the drop.
        """
        space = self._like(
            fit,
            Choice("motor.resistance_fall", free=True),
            Choice("motor.fall_current", free=True),
        )
        m = fit.at.motor
        start = eqx.tree_at(
            lambda t: [t.brush_drop, t.brush_shape, t.brush_tail],
            falling.at.motor,
            [np.asarray(SMALL_PART * float(m.brush_drop)), m.brush_shape, m.brush_tail],
        )
        return self.fitted(fit.rows, space, start)

    def _with_logarithmic_drop(self, fit: OpenLoopFit) -> OpenLoopFit:
        """Return a fit whose drop of the brushes grows with the logarithm of the current.

        The prior of `brush_tail` is for fits in which the drop ends; near 1, its distribution is
        far from a normal one around them.
        """
        space = self._like(
            fit,
            Choice("motor.brush_tail", fixed=LOGARITHMIC_TAIL),
            Choice("motor.brush_shape", free=False),
        )
        # The drop at a large current stays the same.
        m, large = fit.at.motor, LARGE_CURRENT * self._amps
        drop, _ = m.contact_voltage(np.asarray(large), np.asarray(0.0))
        start = eqx.tree_at(
            lambda t: [t.brush_drop, t.brush_tail],
            m,
            [
                np.asarray(float(drop) / np.log1p(large / float(m.brush_current))),
                np.asarray(LOGARITHMIC_TAIL),
            ],
        )
        return self.fitted(fit.rows, space, start)

    def _like(self, fit: OpenLoopFit, *more: Choice) -> Space:
        """Return the search space with the delay and the drift of a fit, and with choices."""
        drifts = "motor.resistance_drift" in fit.space.slices
        drift = [_drift(fit.rows)] if drifts else []
        return self.space([*_fixed_delay(fit), *drift, *more])


def _is_likely_beside(best: OpenLoopFit, fit: OpenLoopFit, stds: float = UNLIKELY_STDS) -> bool:
    """Return True if the advantage of the first fit over another one is not large."""
    finite = np.isfinite(fit.loss) and np.isfinite(best.loss)
    return bool(finite) and advantage(best, fit) <= stds


def _drift(rows: Rows) -> Choice:
    """Return the choice that fits a drift of the resistance."""
    seconds = max(float(rows.time.max()), 1e-9)
    return Choice("motor.resistance_drift", prior_mean=0.0, prior_std=LARGEST_DRIFT / seconds)


def _fixed_delay(fit: OpenLoopFit) -> list[Choice]:
    """Return the choice that fixes the delay of the voltage where a fit has it fixed."""
    if "motor.voltage_delay" in fit.space.slices:
        return []
    return [Choice("motor.voltage_delay", fixed=float(fit.at.motor.voltage_delay))]


def _delayed(motor: BenchMotor, delay: float, rows: Rows) -> BenchMotor:
    late = np.asarray(delay * rows.period)
    moved: BenchMotor = eqx.tree_at(lambda m: m.voltage_delay, motor, late)
    return moved


def _roughly(rows: Rows, at: OpenLoop) -> float:
    """Return the sum of logarithms of both channels' squared errors."""
    errors = (np.stack([rows.current, rows.speed]) - at.readings)[:, rows.used]
    squares = np.mean(errors**2, axis=1)
    return float(np.log(np.maximum(squares, 1e-300))[0 if rows.has_current else 1 :].sum())


def _ranges(
    fits: Sequence[OpenLoopFit], known: Sequence[Uncertainty], weights: Sequence[float]
) -> dict[str, tuple[float, float]]:
    """Return the intervals of resistance and back-EMF over fits, and over the log's currents.

    The first fit is the chosen one, whose resistance may change in the log. Each interval reaches
    to the furthest ends of its mixtures with each other fit, by their weights.
    """
    out: dict[str, tuple[float, float]] = {}
    for path in ("motor.resistance", "motor.back_emf"):
        if path not in fits[0].space.slices:
            continue
        at = [fit.space.slices[path].start for fit in fits]
        centres = np.array([fit.z[k] for fit, k in zip(fits, at, strict=True)])
        stds = np.array([np.sqrt(u.covariance[k, k]) for u, k in zip(known, at, strict=True)])
        pairs = [[0, k] for k in range(len(fits))]
        ends = [mixture_quantiles(centres[p], stds[p], np.array(weights)[p]) for p in pairs]
        low, high = np.exp([min(one[0] for one in ends), max(one[1] for one in ends)])
        if path == "motor.resistance":
            least, most = _factors(fits[0])
            low, high = least * low, most * high
        out[path] = float(low), float(high)
    return out


def _factors(fit: OpenLoopFit) -> tuple[float, float]:
    """Return the smallest and the largest resistance in the log, relative to the fitted one.

    A resistance that falls with current has a range, and so has a winding that warms. What a drop
    of the brushes still rises at large currents may be resistance.
    """
    m, rows = fit.at.motor, fit.rows
    amps = np.abs(fit.at.states[..., 0][rows.used])
    largest = float(amps.max())
    by_current = 1 + np.asarray(m.relative_fall(np.array([SMALL_CURRENT * largest, largest])))
    _, slope = m.contact_voltage(np.asarray(LARGE_CURRENT * largest), np.asarray(0.0))
    warm = float(m.resistance_drift) * rows.inputs.time[rows.used]
    low = min(1.0, *by_current) * (1 + min(0.0, float(warm.min())))
    high = max(1.0, *by_current) * (1 + max(0.0, float(warm.max())))
    return float(low), float(high * (1 + float(slope) / float(m.resistance)))


def _held_out(fit: OpenLoopFit) -> HeldOut:
    def readings(use: np.ndarray) -> Channels:
        weight = use.astype(float)
        some = fit_open_loop(fit.rows, fit.space, fit.z, weight, FOLD_ROUNDS, ROUGHLY_SETTLED)
        return some.at.readings

    return held_out(fit.rows, readings)
