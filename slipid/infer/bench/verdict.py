"""Verdicts on motors of a bench: parameters with intervals, misfits, and remedies.

A misfit is a dependence of residuals on speed, current or time. No parameter is better than weak if
least squares simulate held-out rows better than the fitted motor.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from slipid.infer.bench.fit import MotorFit
from slipid.infer.fit_file import SCHEMA, number_json
from slipid.infer.verdicts.draws import Z95
from slipid.infer.verdicts.estimates import FROM_ZERO, Estimate, derived, estimates
from slipid.infer.verdicts.unidentified import flat_directions, members, sentences
from slipid.infer.verdicts.wording import VOLTAGE
from slipid.support.content import Content
from slipid.support.files import hash_of

BINS = 8
"""Number of bins over speed, current or time, with about equal numbers of rows."""
MISFIT_STDS = 5.0
"""Smallest mean residual of a bin that is reported as a misfit [std of the mean]."""
MISFIT_SHARE = 0.02
"""Smallest mean residual that is reported as a misfit, divided by the range of the channel."""
FEWEST_CELLS = 5
"""Smallest number of cells of time in a bin from which the std of its mean is estimated."""
LONG_CORRELATION_S = 0.3
"""Correlation time of residuals above which a message reports it [s]."""
VAGUE = 0.1
"""Std of resistance or back-EMF over all models that explain a log, relative to the estimate, above
which the verdict is weak."""
LONGEST_TIME_CONSTANT_S = 5e-3
"""Electrical time constant L_a / R above which resistance, inductance, brush drop, dry friction and
the zero of the ammeter are at most weak [s].

Those of small motors are shorter, and an ammeter's low-pass filter has almost the same effect."""
WIDER = 2.0
"""Ratio of a std to that of chance above which a message reports what differs."""


def misfits(fit: MotorFit) -> dict[str, str]:
    """Return a sentence on the largest misfit of each channel, keyed by the channel.

    A misfit is the largest mean residual over bins of speed, current or time. Channels without a
    significant and large misfit are omitted.
    """
    found = {}
    for k, (channel, unit) in enumerate((("current", "A"), ("speed", "rad/s"))):
        if (channel == "speed" or fit.rows.has_current) and (text := _worst(fit, k, channel, unit)):
            found[channel] = text
    return found


def _worst(fit: MotorFit, k: int, channel: str, unit: str) -> str | None:
    """Return a sentence on the most significant misfit of a channel, None if it has none."""
    used = fit.rows.used
    residual, weight = fit.fit.residuals[k][used], fit.fit.weights[k][used]
    measured = (fit.rows.current, fit.rows.speed)[k][used]
    size, largest, sentence = MISFIT_SHARE * float(np.ptp(measured)), MISFIT_STDS, None
    current, speed = (fit.fit.at.states[..., j][used] for j in (0, 1))
    for over, values, of in (
        ("speed", speed, "rad/s"),
        ("current", current, "A"),
        ("time", fit.rows.time[used], "s"),
    ):
        for some in np.array_split(np.argsort(values, kind="stable"), BINS):
            off, stds = _mean(fit, residual, weight, some)
            if abs(off) > size and stds > largest:
                largest, at = stds, values[some]
                sentence = (
                    f"the {channel} is {abs(off):.2g} {unit} "
                    f"{'above' if off > 0 else 'below'} the model's at {at.min():.3g} to "
                    f"{at.max():.3g} {of} ({over}, {stds:.0f} stds): the motor has an effect "
                    "that the model does not include; the intervals are widened accordingly"
                )
    return sentence


def _mean(
    fit: MotorFit,
    residual: Float[np.ndarray, " row"],
    weight: Float[np.ndarray, " row"],
    some: Int[np.ndarray, " some"],
) -> tuple[float, float]:
    """Return the weighted mean residual of some rows, and its size [std of the mean].

    Cells of time as long as the residuals' correlation time count as independent.
    """
    total = float(weight[some].sum())
    if total <= 0:
        return 0.0, 0.0
    off = float(weight[some] @ residual[some]) / total
    cell = max(1, round(fit.uncertainty.correlation_time / fit.period))
    sums = np.bincount(some // cell, weights=weight[some] * (residual[some] - off))
    square = sums**2
    # A std estimated from few cells of time, or dominated by one cell, would not be reliable.
    if np.count_nonzero(square) < FEWEST_CELLS or square.max() > square.sum() / 2:
        return 0.0, 0.0
    return off, abs(off) * total / float(np.sqrt(square.sum()))


ROWS_ELECTRICAL, ROWS_MECHANICAL = 2.0, 6.0
"""Smallest numbers of rows per time constant, L_a / R and J R / C_e^2, that identify L_a and J."""
_NUMBERS_OF = {
    "current": tuple(
        f"motor.{name}"
        for name in ("resistance", "brush_drop", "inductance", "current_offset", "coulomb_friction")
    ),
    "speed": tuple(
        f"motor.{name}"
        for name in ("back_emf", "rotor_inertia", "viscous_friction", "voltage_offset")
    ),
}
"""Paths of the parameters that a misfit of each channel concerns."""
ONE_SPEED_RATIO = 0.05
"""Range of a log's speeds, divided by the largest speed, below which the log has only one operating
point."""
SLOW_ROWS_S = 1.0
"""Time between rows above which a message asks whether the unit of time is right [s]."""
_REMEDIES = (
    (
        ("motor.inductance",),
        "log faster, with several rows per time constant L/R, and with steps of the voltage",
    ),
    (("motor.rotor_inertia",), "accelerate and decelerate within some tenths of a second"),
    (
        ("motor.current_offset", "motor.coulomb_friction"),
        "turn in both directions: otherwise the zero of the ammeter looks like friction",
    ),
    (("motor.coulomb_friction", "motor.viscous_friction"), "turn steadily at several speeds"),
    (("motor.resistance",), "use larger currents: load the shaft, or accelerate it harder"),
    (("motor.back_emf",), "turn at several speeds"),
    (("motor.brush_drop",), "use small and large currents, in both directions"),
    (("motor.viscous_friction",), "turn faster: at these speeds it has little effect"),
)
"""Remedies for flat directions: the first whose quantities all occur in the direction is used."""


@dataclass(frozen=True, eq=False)
class BenchFit:
    """Fitted parameters of the motors of a bench, with verdicts.

    Attributes:
        fits: fit of each motor.
        parameters: estimates, keyed by path, which ends in `@label` if the motor has a label.
        derived: quotients of parameters, keyed by path, whose two parts end in `@label`.
        messages: warnings, one sentence each.
        misfits: sentences on misfits, keyed by label of the motor and by channel.
    """

    fits: tuple[MotorFit, ...]
    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    messages: tuple[str, ...]
    misfits: dict[str, dict[str, str]]

    @property
    def converged(self) -> bool:
        return all(f.converged for f in self.fits)

    @property
    def good(self) -> bool:
        """True if the fits converged, explain the logs and predict held-out rows best."""
        explained = not any(self.misfits.values()) and not any(map(_beaten, self.fits))
        return self.converged and explained

    @property
    def reason(self) -> str:
        """Sentence on how the fits ended."""
        return "; ".join(f"{f.label}: {f.reason}" if f.label else f.reason for f in self.fits)

    def to_json(self) -> Content:
        """Return the content of identified.json."""
        runs = dict.fromkeys((r.name, r.sha256) for f in self.fits for r in f.records)
        return {
            "schema": SCHEMA,
            "drive": "motor",
            "converged": self.converged,
            "explained": self.good,
            "parameters": {path: number_json(e) for path, e in self.parameters.items()},
            "derived": {path: number_json(e) for path, e in self.derived.items()},
            "surfaces": [],
            "curves": {},
            "validity": {},
            **_held_out(self.fits),
            "motors": {
                f.label or "motor": _about(f, list(self.misfits[f.label].values()))
                for f in self.fits
            },
            "messages": list(self.messages),
            "data": {"hash": hash_of(runs), "runs": [name for name, _ in runs]},
        }


def bench_fit(fits: Sequence[MotorFit]) -> BenchFit:
    """Return the estimates, verdicts and messages of fitted motors."""
    parameters: dict[str, Estimate] = {}
    ratios: dict[str, Estimate] = {}
    messages: list[str] = []
    found = {f.label: misfits(f) for f in fits}
    for f in fits:
        slow, voltage = _too_slow(f), f.has_voltage
        directions = flat_directions(f.space, f.covariance, f.has_current, voltage)
        flat = [replace(one, remedy=_remedy(one.paths, voltage)) for one in directions]
        numbers = estimates(f.space, f.choices, f.z, f.covariance, voltage, members(flat))
        filtered = {"current"} if _slow_current(f) is not None else set()
        misfitted = {
            path for channel in {*found[f.label], *filtered} for path in _NUMBERS_OF[channel]
        }
        quotients = derived(f.space, f.z, f.covariance, voltage)
        judged = {
            e.path: _with_verdict(f, _with_range(f, e), slow, misfitted)
            for e in (*numbers, *quotients)
        }
        if not f.has_current:
            judged = {e.path: e for e in voltage_gains(f, judged)}
        for path, e in judged.items():
            full = "/".join(f"{p}@{f.label}" if f.label else p for p in path.split("/"))
            into = ratios if "/" in path else parameters
            into[full] = replace(e, path=full)
        own = [*slow.values(), *sentences(flat), *found[f.label].values(), *_remarks(f)]
        messages += [f"{f.label}: {text}" if f.label else text for text in own]
    return BenchFit(tuple(fits), parameters, ratios, tuple(messages), found)


def _with_range(f: MotorFit, e: Estimate) -> Estimate:
    """Return an estimate with the interval of all models that explain the log, if there is one.

    If the models differ much (`VAGUE`), the verdict is at most weak.
    """
    if e.path not in f.ranges or e.verdict == "fixed":
        return e
    low, high = f.ranges[e.path]
    std = (high - low) / (2 * Z95)
    weak = e.verdict == "identified" and std > VAGUE * e.value
    return replace(e, interval90=(low, high), std=std, verdict="weak" if weak else e.verdict)


_GAINS = {
    "kS": ("V", "voltage against dry friction", ("motor.coulomb_friction", 1, -1)),
    "kV": ("V*s/rad", "voltage per shaft speed", ("motor.back_emf", 0, 1)),
    "kA": ("V*s^2/rad", "voltage per acceleration of the shaft", ("motor.rotor_inertia", 1, -1)),
}
"""Unit, meaning and numbers of the gains of a log without a current: tau_c / C_e, C_e and J / C_e.

The resistance is 1 ohm there, so that torques over C_e are voltages."""


def voltage_gains(f: MotorFit, judged: Mapping[str, Estimate]) -> list[Estimate]:
    """Return kS, kV, kA and kG of a motor whose current was not logged.

    `judged` are the estimates of the numbers from which the gains follow, keyed by path.
    """
    out, slices = [], f.space.slices
    for name, (unit, doc, (path, power, emf)) in _GAINS.items():
        direction = np.zeros(len(f.z))
        if power:
            direction[slices[path]] = power
        direction[slices["motor.back_emf"]] += emf
        std = float(np.sqrt(direction @ f.covariance @ direction))
        value = float(np.exp(direction @ f.z))
        ends = float(np.exp(-Z95 * std) * value), float(np.exp(min(Z95 * std, 300.0)) * value)
        out.append(
            Estimate(
                path=f"motor.{name}",
                unit=unit,
                doc=doc,
                value=value,
                std=std * value,
                interval90=ends,
                verdict=judged[path].verdict,
                provenance=judged[path].provenance,
                ratio=judged[path].ratio,
            )
        )
    lift = "voltage against gravity, or the zero of the voltmeter"
    delay = "time from a logged voltage to its speed"
    kept = (("voltage_offset", "kG", lift), ("voltage_delay", "voltage_delay", delay))
    for number, name, doc in kept:
        out.append(replace(judged[f"motor.{number}"], path=f"motor.{name}", doc=doc))
    return out


def _remedy(paths: Sequence[str], has_voltage: bool) -> str:
    electrical = {"motor.resistance", "motor.back_emf", "motor.brush_drop", "motor.inductance"}
    if not has_voltage and {*paths} & (electrical | {"motor.voltage_offset"}):
        return VOLTAGE
    for needed, text in _REMEDIES:
        if {*paths} >= {*needed}:
            return text
    return "turn in both directions, at several speeds, with small and large currents"


def _too_slow(f: MotorFit) -> dict[str, str]:
    """Return sentences on time constants that are too short for the rows, keyed by parameter."""
    m, rows, slow = f.motor, f.period, {}
    if not f.has_voltage:
        return {}
    electrical = max(float(m.inductance), 0.0) / float(m.resistance)
    mechanical = float(m.rotor_inertia * m.resistance / m.back_emf**2)
    for path, constant, least, name in (
        ("motor.inductance", electrical, ROWS_ELECTRICAL, "L_a / R"),
        ("motor.rotor_inertia", mechanical, ROWS_MECHANICAL, "J R / C_e^2"),
    ):
        if path in f.space.slices and constant < least * rows:
            about = f"about {_time(constant)}" if constant > 0.05 * rows else "far shorter"
            slow[path] = (
                f"{path} is not identified at this sampling rate: its time constant {name} is "
                f"{about}, and rows are {_time(rows)} apart; log at least {least:g} rows per time "
                "constant"
            )
    return slow


def _slow_current(f: MotorFit) -> float | None:
    """Return the electrical time constant if it is fitted and longer than usual [s], else None."""
    if "motor.inductance" not in f.space.slices or not f.has_voltage:
        return None
    constant = float(f.motor.inductance / f.motor.resistance)
    at = f.space.slices["motor.inductance"].start
    least = constant * np.exp(-Z95 * np.sqrt(f.covariance[at, at]))
    return constant if least > LONGEST_TIME_CONSTANT_S else None


def _one_point(f: MotorFit) -> bool:
    """Return True if the speed is nearly constant (`ONE_SPEED_RATIO`)."""
    speed = f.rows.speed[f.rows.used]
    spread = float(np.ptp(np.quantile(speed, (0.02, 0.98))))
    return spread < ONE_SPEED_RATIO * float(np.abs(speed).max())


def _beaten(f: MotorFit) -> bool:
    """Return True if least squares simulate held-out rows better."""
    return f.held_out is not None and bool(f.held_out.worse_than)


def _time(seconds: float) -> str:
    return f"{1e3 * seconds:.2g} ms" if seconds < 1 else f"{seconds:.2g} s"


def _with_verdict(
    f: MotorFit, e: Estimate, slow: Collection[str], misfitted: Collection[str]
) -> Estimate:
    """Return an estimate with a weaker verdict if the logs do not support its present one.

    Reasons are rows too far apart (`slow`), a single speed, an inductance near 0, a misfit of the
    parameter's channel (`misfitted`), and a rival that simulates held-out rows better.
    """
    if (e.path in slow or _one_point(f)) and e.verdict not in ("fixed", "not_identified"):
        return replace(e, verdict="not_identified", provenance="borrowed")
    small = e.path == "motor.inductance" and e.std is not None and e.value < FROM_ZERO * e.std
    doubtful = small or bool({*e.path.split("/")} & {*misfitted}) or _beaten(f)
    return replace(e, verdict="weak") if doubtful and e.verdict == "identified" else e


def _remarks(f: MotorFit) -> list[str]:
    """Return warnings on the operating points, channels and sampling of the logs."""
    found = []
    if _one_point(f):
        found.append(
            "speed and voltage are constant, so that no parameter is determined: turn at several "
            "speeds, in both directions, and accelerate and decelerate"
        )
    if not f.has_voltage:
        found.append(
            "without a voltage neither resistance nor back-EMF is identified; friction and inertia "
            f"are identified only relative to the back-EMF; {VOLTAGE}"
        )
    if not f.has_current:
        found.append(
            "without a current the log determines kS, kV and kA, the voltages for friction, speed "
            "and acceleration, but neither resistance nor back-EMF: log the motor current"
        )
    elif not f.rows.signed:
        found.append(
            "currents are magnitudes: the zero of the ammeter cannot be distinguished from friction"
        )
    if f.held_out is not None and f.held_out.worse_than:
        found.append(
            "least squares simulate the held-out rows better than the fitted model, so that no "
            "number is better than weak: the model lacks something that acts in this motor"
        )
    if "falling" in f.other_contacts:
        found.append(
            "a voltage drop of the brushes and a resistance that falls with current explain the "
            "log about equally well: the interval of the resistance includes both"
        )
    if "both" in f.other_contacts:
        found.append(
            "a voltage drop of the brushes together with a resistance that falls with current "
            "explains the log about as well: the interval of the resistance includes it"
        )
    if "logarithmic" in f.other_contacts:
        found.append(
            "a voltage drop of the brushes that grows with the logarithm of the current explains "
            "the log about as well: the interval of the resistance includes it"
        )
    if f.other_forms:
        others = " or ".join(f.other_forms)
        found.append(
            f"the voltage between rows is {f.between} or {others}, which the log does not "
            "distinguish: the intervals of resistance and back-EMF include all of them; give "
            "--between (voltage_between_rows in a config) if you know it"
        )
    found += _disagreements(f)
    if (constant := _slow_current(f)) is not None:
        found.append(
            f"the time constant L_a / R is {_time(constant)}, longer than those of usual motors: a "
            "low-pass filter of the ammeter looks almost the same, but changes the resistance; log "
            "the unfiltered current"
        )
    if f.period > SLOW_ROWS_S:
        found.append(
            f"rows are {f.period:.3g} s apart: if the time is in milliseconds, set its unit (t:ms);"
            " inertia and inductance depend on it"
        )
    known = f.uncertainty
    if known.correlation_time > LONG_CORRELATION_S:
        found.append(
            f"residuals are correlated over {known.correlation_time:.2g} s: the intervals are "
            f"computed from {known.independent_times:.0f} independent intervals of twice that "
            "time, not from all rows"
        )
    if "motor.rotor_inertia" in f.space.slices:
        name = "motor.rotor_inertia" if f.has_current else "motor.kA"
        found.append(f"{name} includes everything that turned together with the rotor")
    return found


def _disagreements(f: MotorFit) -> list[str]:
    """Return sentences on resistance and back-EMF that differ between preferences for rows."""
    found = []
    for path, symbol in (("motor.resistance", "R"), ("motor.back_emf", "C_e")):
        if path not in f.space.slices:
            continue
        at = f.space.slices[path].start
        wide = np.sqrt(f.covariance[at, at] / f.uncertainty.chance[at, at])
        name, off = max(f.uncertainty.spread.items(), key=lambda item: abs(item[1][at]))
        if wide > WIDER and abs(off[at]) > f.uncertainty.chance[at, at] ** 0.5:
            value = float(np.exp(f.z[at]))
            found.append(
                f"{symbol} would be {value * float(np.exp(off[at])):.4g} instead of {value:.4g} if "
                f"{name} counted more, which is more than chance: the interval is wider by that"
            )
    return found


def _held_out(fits: Sequence[MotorFit]) -> Content:
    """Return the errors on held-out rows, of the only motor or of each one by its label."""
    known = {f.label: f.held_out.to_json() for f in fits if f.held_out is not None}
    return {"held_out": known.get("", known)} if known else {}


def _about(f: MotorFit, misfit: list[str]) -> Content:
    """Return the part of identified.json about the fit of one motor."""
    return {
        "rounds": f.rounds,
        "reason": f.reason,
        "row_period_s": f.period,
        "noise": f.noise,
        "memory_s": f.uncertainty.correlation_time,
        "rows": int(f.rows.used.sum()),
        "voltage_between_rows": f.between if f.has_voltage else None,
        "misfit": misfit,
    }
