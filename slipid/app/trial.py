"""`slipid trial`: the rectangle of the 2021 paper's figure 7 with every controller, judged."""

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from slipid.app import files, runtime
from slipid.app.freeze import fit_hash, frozen_of, load_of, sensors_of
from slipid.app.progress import Reporter
from slipid.app.spread import spread
from slipid.control import closed_loop, reference, tuning
from slipid.control.controller import GAINS, Controller, Correction
from slipid.control.estimator import Estimator, Settings
from slipid.control.frozen import Frozen
from slipid.control.habits import Habits
from slipid.control.odometry import Odometry
from slipid.data.files import read_json, write_arrays, write_json
from slipid.data.log import DataError
from slipid.data.terrain import FloorMap, patchwork, read_map
from slipid.identify.result import Fit, load

SCHEMA = "slipid.trial/1"
FOLDER = "trial"
"""Finished runs, below OUT."""
SITE_SEED, STARTS_SEED = 7, 2021
REST_S = 1.0
"""For which the robot stands before it drives: a gyro learns its zero [s]."""
HAND = dict(zip(GAINS, tuning.HAND, strict=True))
"""Gains where none were tuned."""
PLANTS = ("testsite", "twin")


@dataclass(frozen=True)
class Row:
    """One controller of the trial.

    Attributes:
        observer: `encoder`, `curve` (slip over current, wheel by wheel) or `contact`.
        correction: of the 2021 paper.
        tuned: whether it has the gains of `slipid tune`, where there are any.
        ahead: whether wheel speeds come from the inverse contact model, whatever the gains say.
        gyro: whether the robot has one.
        about: one sentence for people.
    """

    observer: str
    about: str
    correction: Correction = "none"
    tuned: bool = False
    ahead: bool = False
    gyro: bool = False


ROWS: Mapping[str, Row] = {
    "encoder": Row("encoder", "believes its encoders"),
    "slip_odometry": Row("curve", "odometry less slip over current (figure 5)"),
    "paper_print": Row("curve", "and torque correction as printed", "paper_print"),
    "paper_code": Row("curve", "and torque correction as its authors ran it", "paper_code"),
    "torque": Row("curve", "and torque correction, corrected", "torque"),
    "lyapunov": Row("contact", "the common pose loop, a Lyapunov law; gains set by hand"),
    "contact_ahead": Row("contact", "and wheel speeds of the inverse contact model", ahead=True),
    "contact": Row("contact", "as lyapunov, tuned gains where there are any", tuned=True),
    "contact_gyro": Row("contact", "contact, with a gyro", tuned=True, gyro=True),
}


@dataclass(frozen=True, eq=False)
class Job:
    """One run of one controller from one start."""

    name: str
    row: str
    start: tuple[float, float, float]
    seed: int
    plant: str
    load: str
    floor: FloorMap
    frozen: Frozen
    settings: Settings
    habits: Habits
    gains: Mapping[str, float]
    out: Path


@dataclass(frozen=True)
class Wish:
    """What is asked of a trial.

    Attributes:
        plant: `testsite` (MuJoCo) or `twin` (the identified model itself).
        map: file of a floor map; None for patches of the identified floors.
        controllers: names of `ROWS`.
        starts: how many.
        load: name of the load set-up; None for the first.
        jobs: processes at once.
    """

    plant: str = "testsite"
    map: Path | None = None
    controllers: tuple[str, ...] = tuple(ROWS)
    starts: int = 20
    load: str | None = None
    jobs: int = 1


def site(fit: Fit) -> FloorMap:
    """Patches of about the robot's size, half of them of the floor on which it slips least.

    On the test site's firm, medium and soft floors encoders then travel 80 to 90 % of the first
    side, as on the paper's site.
    """
    labels = fit.robot.surfaces.labels
    slip = [float(np.mean(fit.validity[f]["slip"])) for f in labels]
    order = [labels[k] for k in np.argsort(slip)]
    names = order if len(order) == 1 else [*order, "more of the first"]
    drawn = patchwork(names, seed=SITE_SEED, patch=0.35, half=2.0)
    cells = np.where(drawn.cells == len(order), 0, drawn.cells)
    return FloorMap(tuple(order), cells, drawn.corner, drawn.cell)


def starts(
    count: int, floor: FloorMap, sides: tuple[float, float] = (0.9, 0.4)
) -> list[tuple[float, float, float]]:
    """Poses all over a site in evenly spread headings, the same ones for every controller.

    Args:
        count: how many.
        floor: the site; the rectangle's middle keeps 0.8 m from its edge where there is room.
        sides: of the rectangle [m].
    """
    rng = np.random.default_rng(STARTS_SEED)
    x0, y0, x1, y1 = floor.extent
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    reach = np.maximum([0.5 * (x1 - x0) - 0.8, 0.5 * (y1 - y0) - 0.8], 0.0)
    out = []
    for k in range(count):
        heading = (k + rng.uniform()) * 2 * np.pi / count - np.pi
        c, s = np.cos(heading), np.sin(heading)
        x, y = middle + reach * rng.uniform(-1.0, 1.0, 2)
        a, b = 0.5 * sides[0], 0.5 * sides[1]
        out.append((float(x - (c * a + s * b)), float(y - (s * a - c * b)), float(heading)))
    return out


def trial(out: Path, wish: Wish, report: Reporter) -> dict[str, Any]:
    """Drive every controller from every start; what trial.json holds.

    Runs that are done are kept, and not driven again as long as nothing they depend on changes.

    Raises:
        DataError: no fit, no such plant, controller, load or map, MuJoCo missing, or floors that
            the plant or the fit does not know.
    """
    runtime.start()
    jobs = _jobs(out, wish)
    todo = [job for job in jobs if not _file(job).is_file()]
    report.stage(f"driving {len(todo)} of {len(jobs)} runs")
    began = time.monotonic()
    with closing(spread(drive, todo, min(wish.jobs, max(len(todo), 1)))) as finished:
        for done, (job, _) in enumerate(finished, 1):
            left = (time.monotonic() - began) / done * (len(todo) - done)
            report.step(done, len(todo), f"{job.name}, about {left:.0f} s left")
    runs = [_kept(job) for job in jobs]
    table = summary(runs)
    content = {
        "schema": SCHEMA,
        "plant": wish.plant,
        "map": "patches" if wish.map is None else str(wish.map),
        "gains": dict(jobs[0].gains),
        "closes_best": min(table, key=lambda name: table[name]["closure_error_median"]),
        "summary": table,
        "controllers": {name: ROWS[name].about for name in wish.controllers},
        "runs": runs,
    }
    write_json(out / "trial.json", content)
    from slipid.app.plots_trial import trial_plot

    report.stage("drawing")
    paths = {job.name: _path(job) for job in jobs}
    trial_plot(content, paths, jobs[0].floor, out / "trial.png")
    return content


def _jobs(out: Path, wish: Wish) -> list[Job]:
    if wish.plant not in PLANTS:
        raise DataError(f"no plant '{wish.plant}'; expected {' or '.join(PLANTS)}")
    for name in wish.controllers:
        if name not in ROWS:
            raise DataError(f"no controller '{name}'; expected some of {', '.join(ROWS)}")
    if not wish.controllers:
        raise DataError(f"no controller; expected some of {', '.join(ROWS)}")
    fit = load(out)
    frozen = jax.tree.map(np.asarray, frozen_of(fit, wish.load))
    floor = site(fit) if wish.map is None else read_map(wish.map)
    labels = fit.robot.surfaces.labels
    if wish.plant == "twin":
        for name in floor.surfaces:
            if name not in labels:
                raise DataError(f"{wish.map}: no surface '{name}'; identified: {', '.join(labels)}")
    name = load_of(fit, wish.load)
    if wish.plant != "twin":
        _known_to_site(floor, name, frozen.wheels)
    gains = gains_of(out, fit_hash(fit), name)
    settings, habits = sensors_of(fit, gyro=False)
    if wish.plant != "twin":  # the test site has the sensors it has, whatever the logs had
        settings, habits = replace(settings, current_is_signed=False), Habits()
    mark = sha256()
    for leaf in jax.tree.leaves(frozen):
        mark.update(np.ascontiguousarray(leaf).tobytes())
    mark.update(repr((wish.plant, name, floor.surfaces, floor.corner, floor.cell, gains)).encode())
    mark.update(repr((settings, habits)).encode())
    mark.update(floor.cells.tobytes())
    # runs of other code are not taken for this one's
    mark.update(files.code("control", "model", "testsite", "data", "app"))
    mark.update(repr(sorted(files.versions().items())).encode())
    folder = out / FOLDER / mark.hexdigest()[:12]
    return [
        Job(
            name=f"{row}/start{k:02d}",
            row=row,
            start=start,
            seed=1000 + k,
            plant=wish.plant,
            load=name,
            floor=floor,
            frozen=frozen,
            settings=settings,
            habits=habits,
            gains=gains,
            out=folder / f"of{wish.starts}",
        )
        for row in wish.controllers
        for k, start in enumerate(starts(wish.starts, floor))
    ]


def _known_to_site(floor: FloorMap, load: str, wheels: int) -> None:
    from slipid.testsite.driving import Site
    from slipid.testsite.ground import GROUNDS

    machine = Site().machine
    if wheels != len(machine.wheel_azimuths_deg):
        raise DataError(
            f"the test site's robot has {len(machine.wheel_azimuths_deg)} wheels, the fit's "
            f"{wheels}. With --plant twin the identified model is driven itself"
        )
    if load not in machine.centres_m:
        raise DataError(
            f"the test site has no load set-up '{load}'; it has {', '.join(machine.centres_m)}. "
            "With --plant twin the identified model is driven itself"
        )
    for name in floor.surfaces:
        if name not in GROUNDS:
            raise DataError(
                f"the test site has no surface '{name}'; it has {', '.join(GROUNDS)}. "
                "With --plant twin the identified model is driven itself"
            )


def gains_of(out: Path, fit: dict[str, str], load: str) -> dict[str, float]:
    """Gains that `slipid tune` found, else those set by hand.

    Args:
        out: folder of the fit.
        fit: its hash, see `fit_hash`.
        load: set-up it is to drive with.

    Raises:
        DataError: gains.json is damaged, or of another fit or load set-up.
    """
    path = out / "gains.json"
    if not path.is_file():
        return dict(HAND)
    content = read_json(path, "what slipid tune wrote")
    try:
        found = {name: float(content["gains"][name]["value"]) for name in GAINS}
        of, with_load = content["fit"], content["settings"]["load"]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: no gains ({error}); expected what slipid tune writes") from error
    if of != fit or with_load != load:
        raise DataError(
            f"{path}: tuned for another fit or load set-up ({with_load}); run slipid tune again, "
            "or remove it to drive with gains set by hand"
        )
    if not np.all(np.isfinite(list(found.values()))):
        raise DataError(f"{path}: a gain is no number; run slipid tune again")
    return found


def _file(job: Job) -> Path:
    return job.out / f"{job.name}.json"


def _path(job: Job) -> np.ndarray:
    with np.load(_file(job).with_suffix(".npz")) as kept:
        return np.asarray(kept["pose"])


def _kept(job: Job) -> dict[str, Any]:
    content: dict[str, Any] = read_json(_file(job), "a run of slipid trial")
    return content


def pilot_of(
    frozen: Frozen, settings: Settings, row: Row, gains: Mapping[str, float]
) -> closed_loop.Pilot:
    """Estimator and controller of a row."""
    own = {**HAND, **(gains if row.tuned else {}), **({"ahead": 1.0} if row.ahead else {})}
    observer: Any = Estimator(frozen, settings)
    if row.observer != "contact":
        observer = Odometry(frozen, settings, curve=row.observer == "curve")
        own["preview"] = 0.0  # the paper's loop has none
    values = jnp.asarray([own[name] for name in GAINS])
    return closed_loop.Pilot(observer, Controller(frozen, values, correction=row.correction))


def drive(job: Job) -> float:
    """Drive one run and write its metrics and its path; how long it took [s]."""
    _started()
    row = ROWS[job.row]
    frozen = jax.tree.map(jnp.asarray, job.frozen)
    path = reference.rectangle().moved(job.start).waiting(REST_S)
    plant = _plant(job, row.gyro, frozen)
    pilot = pilot_of(frozen, job.settings, row, job.gains)
    course = closed_loop.drive(pilot, path, plant, job.start)
    found = closed_loop.metrics(course)
    off = course.pose[-1] - course.believed[-1]
    found["believed_error_mm"] = 1000 * float(np.hypot(off[0], off[1]))
    about = {"controller": job.row, "start": list(job.start), "seed": job.seed}
    # the path first: a run that has metrics is done
    write_arrays(
        _file(job).with_suffix(".npz"),
        {"time": course.time, "pose": course.pose, "believed": course.believed},
    )
    write_json(_file(job), {**about, **found})
    return float(course.time[-1])


@lru_cache(maxsize=1)
def _started() -> None:
    runtime.start()


def _plant(job: Job, gyro: bool, frozen: Frozen) -> Any:
    if job.plant == "twin":
        from slipid.app.plants import twin

        return twin(frozen, job.floor, job.start, job.seed, replace(job.habits, gyro=gyro))
    from slipid.app.plants import SitePlant

    return SitePlant(job.floor, job.load, job.start, job.seed, gyro)


def summary(runs: Sequence[Mapping[str, Any]], draws: int = 2000) -> dict[str, dict[str, Any]]:
    """Medians over starts of every controller, with 90 % bootstrap intervals.

    `first_side_along_track_mm` and `heading_error_deg` are medians of the errors' sizes;
    `first_side_travelled` is the median part of the first side; `to_encoder` are ratios of medians
    to those of `encoder`, with intervals over the starts they share. What a plant does not know
    (the twin's energy) is left out.
    """
    names = list(dict.fromkeys(r["controller"] for r in runs))
    of = {n: [r for r in runs if r["controller"] == n] for n in names}
    table = {n: _columns(of[n]) for n in names}
    rng = np.random.default_rng(0)
    count = min(len(c["closure_error_median"]) for c in table.values())
    again = rng.integers(count, size=(draws, count))
    out: dict[str, dict[str, Any]] = {}
    for name, columns in table.items():
        known = {k: v for k, v in columns.items() if np.all(np.isfinite(v))}
        row: dict[str, Any] = {k: float(np.median(v)) for k, v in known.items()}
        row["interval90"] = {
            k: np.quantile(np.median(v[again], axis=1), [0.05, 0.95]).tolist()
            for k, v in known.items()
        }
        row["runs"] = len(columns["closure_error_median"])
        row["finished_share"] = float(np.mean([r["finished"] for r in of[name]]))
        if "encoder" in table:
            row["to_encoder"] = _ratios(columns, table["encoder"], again)
        out[name] = row
    return out


def _columns(runs: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    side = np.array([r["along_track_mm"][0] for r in runs])
    plain = ("path_length_mm", "energy_j", "effort", "seconds", "believed_error_mm")
    return {
        "first_side_along_track_mm": np.abs(side),
        "first_side_travelled": 1 + side / 900.0,
        "closure_error_median": np.array([r["closure_mm"] for r in runs]),
        "cross_track_rmse": np.array([r["cross_track_rmse_mm"] for r in runs]),
        "heading_error_deg": np.abs([r["heading_error_deg"] for r in runs]),
        **{k: np.array([np.nan if r[k] is None else float(r[k]) for r in runs]) for k in plain},
    }


def _ratios(
    mine: Mapping[str, np.ndarray], base: Mapping[str, np.ndarray], again: np.ndarray
) -> dict[str, Any]:
    out = {}
    for key in ("closure_error_median", "cross_track_rmse", "first_side_along_track_mm"):
        a, b = np.median(mine[key][again], axis=1), np.median(base[key][again], axis=1)
        low, high = np.quantile(a / np.maximum(b, 1e-9), [0.05, 0.95])
        value = float(np.median(mine[key]) / max(float(np.median(base[key])), 1e-9))
        out[key] = {"value": value, "interval90": [float(low), float(high)]}
    return out


def processes(jobs: int | None) -> int:
    """How many at once."""
    return jobs or os.cpu_count() or 1


def names_of(text: str | None) -> tuple[str, ...]:
    """Controllers of a list by commas, all of them by default."""
    if text is None:
        return tuple(ROWS)
    return tuple(dict.fromkeys(t.strip() for t in text.split(",") if t.strip()))
