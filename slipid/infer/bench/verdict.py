"""Verdicts on motors of a bench: parameters with intervals, misfits, and remedies.

A misfit is a dependence of residuals on speed, current or time.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.moments import Equation, cell_length, celled
from slipid.infer.fit_file import SCHEMA, number_json
from slipid.infer.verdicts.estimates import FROM_ZERO, Estimate, derived, estimates
from slipid.infer.verdicts.unidentified import flat_directions, members, sentences
from slipid.infer.verdicts.wording import VOLTAGE
from slipid.support.content import Content
from slipid.support.files import hash_of

BINS = 8
"""Number of bins over speed, current or time, with about equal numbers of windows."""
MISFIT_STDS = 5.0
"""Smallest mean residual of a bin that is reported as a misfit [std of the mean]."""
MISFIT_SHARE = 0.01
"""Smallest mean residual that is reported as a misfit, divided by the range of the channel."""
FEWEST_CELLS = 5
"""Smallest number of cells of time in a bin from which the std of its mean is estimated."""
LONG_CORRELATION_S = 0.3
"""Correlation time of residuals above which a message reports it [s]."""


def misfits(fit: MotorFit) -> dict[str, str]:
    """Return a sentence on the largest misfit of each equation, keyed by the equation's channel.

    A misfit is the largest mean residual over bins of speed, current or time. Equations without a
    significant and large misfit are omitted.
    """
    return {e.channel: text for e in fit.equations if (text := _worst(fit, e)) is not None}


def _worst(fit: MotorFit, equation: Equation) -> str | None:
    """Return a sentence on the most significant misfit of an equation, None if it has none."""
    w, sentence, largest = equation.windows, None, MISFIT_STDS
    size = MISFIT_SHARE * float(np.ptp(w.measured.mean(axis=0)))
    used = np.flatnonzero(w.usable)
    for over, (even, odd), unit in (
        ("speed", w.speed, "rad/s"),
        ("current", w.current, "A"),
        ("time", (w.time, w.time), "s"),
    ):
        # A residual's own noise must not choose its bin: residuals of even rows are binned by odd
        # rows, and vice versa.
        bins = [np.array_split(used[np.argsort(v[used], kind="stable")], BINS) for v in (odd, even)]
        for some in zip(*bins, strict=True):
            off, sure = _mean(fit, equation, *some)
            if abs(off) > size and sure > largest:
                largest, at = sure, odd[some[0]]
                sentence = (
                    f"the {equation.channel} is {abs(off):.2g} {equation.unit} "
                    f"{'above' if off > 0 else 'below'} the model's at {at.min():.3g} to "
                    f"{at.max():.3g} {unit} ({over}, {sure:.0f} stds): the motor has an effect "
                    "that the model does not include; the intervals are widened accordingly"
                )
    return sentence


def _mean(
    fit: MotorFit, equation: Equation, even: Int[np.ndarray, " some"], odd: Int[np.ndarray, " some"]
) -> tuple[float, float]:
    """Return the weighted mean residual of some windows, and its size [std of the mean].

    `even` and `odd` are the windows whose residuals of even and of odd rows are averaged. Cells of
    time as long as the residuals' correlation time count as independent.
    """
    w = equation.windows
    weight, sum_ = np.zeros(len(w.time)), np.zeros(len(w.time))
    for half, some in enumerate((even, odd)):
        weight[some] += equation.weight[half, some]
        sum_[some] += equation.weight[half, some] * equation.residual[half, some]
    total = float(weight.sum())
    if total <= 0:
        return 0.0, 0.0
    off = float(sum_.sum()) / total
    length = max(fit.correlation_time, cell_length([w]))
    away = celled((sum_ - weight * off)[:, None], w, length)
    square = away[:, 0] ** 2
    # A std estimated from few cells of time, or dominated by one cell, would not be reliable.
    if np.count_nonzero(square) < FEWEST_CELLS or square.max() > square.sum() / 2:
        return 0.0, 0.0
    return off, abs(off) * total / float(np.sqrt(square.sum()))


ROWS_ELECTRICAL, ROWS_MECHANICAL = 2.0, 6.0
"""Smallest numbers of rows per time constant, L_a / R and J R / C_e^2, that identify L_a and J."""
_NUMBERS_OF = {
    "voltage": tuple(
        f"motor.{name}"
        for name in ("resistance", "back_emf", "brush_drop", "inductance", "voltage_offset")
    ),
    "current": tuple(
        f"motor.{name}"
        for name in ("coulomb_friction", "viscous_friction", "rotor_inertia", "current_offset")
    ),
}
"""Paths of the parameters that the equation of each channel determines."""
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
        "turn in both directions: otherwise the zero of the ammeter cannot be told from friction",
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
        """True if the fits converged and explain the logs."""
        return self.converged and not any(self.misfits.values())

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
        directions = flat_directions(f.space, f.covariance, has_current=True, has_voltage=voltage)
        flat = [replace(one, remedy=_remedy(one.paths, voltage)) for one in directions]
        numbers = estimates(f.space, f.choices, f.z, f.covariance, voltage, members(flat))
        misfitted = {path for channel in found[f.label] for path in _NUMBERS_OF[channel]}
        quotients = derived(f.space, f.z, f.covariance, voltage)
        for into, estimated in ((parameters, numbers), (ratios, quotients)):
            for e in estimated:
                path = "/".join(f"{p}@{f.label}" if f.label else p for p in e.path.split("/"))
                into[path] = replace(_with_verdict(f, e, slow, misfitted), path=path)
        own = [*slow.values(), *sentences(flat), *found[f.label].values(), *_remarks(f)]
        messages += [f"{f.label}: {text}" if f.label else text for text in own]
    return BenchFit(tuple(fits), parameters, ratios, tuple(messages), found)


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


def _one_point(f: MotorFit) -> bool:
    """Return True if the speed is nearly constant (`ONE_SPEED_RATIO`)."""
    amps = f.equations[-1].windows
    used = amps.speed.mean(axis=0)[amps.usable]
    return float(np.ptp(np.quantile(used, (0.02, 0.98)))) < ONE_SPEED_RATIO * float(
        np.abs(used).max()
    )


def _time(seconds: float) -> str:
    return f"{1e3 * seconds:.2g} ms" if seconds < 1 else f"{seconds:.2g} s"


def _with_verdict(
    f: MotorFit, e: Estimate, slow: Collection[str], misfitted: Collection[str]
) -> Estimate:
    """Return an estimate with a weaker verdict if the logs do not support its present one.

    Reasons are rows too far apart (`slow`), a single speed, an inductance near 0, and a misfit of
    the parameter's equation (`misfitted`).
    """
    if (e.path in slow or _one_point(f)) and e.verdict not in ("fixed", "not_identified"):
        return replace(e, verdict="not_identified", provenance="borrowed")
    small = e.path == "motor.inductance" and e.std is not None and e.value < FROM_ZERO * e.std
    if e.verdict == "identified" and (small or {*e.path.split("/")} & {*misfitted}):
        return replace(e, verdict="weak")
    return e


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
    if not all(r.signed for r in f.records):
        found.append(
            "currents are magnitudes: they were given the sign of the speed, windows in which "
            "the motor may brake were not used, and the zero of the ammeter cannot be "
            "distinguished from friction"
        )
    if f.period > SLOW_ROWS_S:
        found.append(
            f"rows are {f.period:.3g} s apart: if the time is in milliseconds, set its unit (t:ms);"
            " inertia and inductance depend on it"
        )
    if f.correlation_time > LONG_CORRELATION_S:
        found.append(
            f"residuals are correlated over {f.correlation_time:.2g} s: the intervals are "
            f"computed from {f.independent_times:.0f} independent intervals of twice that time, "
            "not from all rows"
        )
    if "motor.rotor_inertia" in f.space.slices:
        found.append("motor.rotor_inertia includes everything that turned together with the rotor")
    return found


def _about(f: MotorFit, misfit: list[str]) -> Content:
    """Return the part of identified.json about the fit of one motor."""
    windows = [e.windows for e in f.equations]
    return {
        "rounds": f.rounds,
        "reason": f.reason,
        "row_period_s": f.period,
        "noise": f.noise,
        "memory_s": f.correlation_time,
        "windows": [len(w.time) for w in windows],
        "usable": [float(np.round(w.usable.mean(), 3)) for w in windows],
        "misfit": misfit,
    }
