"""The virtual test site against the real logs, and slipid's claims against its truth.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_testsite.py

(-k speed, sectors, mixed, figures or coverage). Pictures and experiments go to
out/bench_testsite/CODE, where coverage goes on after an interrupt.
"""

import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np

from slipid.app.config import parsed
from slipid.app.problem import read_fit_task
from slipid.data.floor_map import FloorMap, four_zones, patchwork
from slipid.lab.testsite.config import plan
from slipid.lab.testsite.driving import SiteRun, TimedTwists, drive, straight
from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.plant import SimulatedRobot
from slipid.lab.testsite.sections import HeadingRuns, PaperGridRuns, RectangleRuns, WanderRuns
from slipid.lab.testsite.simulate import log_of, simulate, truth
from slipid.lab.testsite.site import Site
from slipid.lab.testsite.surfaces import SURFACES
from slipid.predict.ranking import compared
from slipid.support.executor import Processes
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK, quick

ROOT = Path(__file__).resolve().parents[2]
CODE = sha256(b"".join(p.read_bytes() for p in sorted((ROOT / "slipid").rglob("*.py"))))
OUT = ROOT / "out" / "bench_testsite" / CODE.hexdigest()[:8]  # nothing of other code is reused
SEEDS = int(os.environ.get("SLIPID_BENCH_SEEDS", quick("40", "1")))

HEADINGS = """
[[runs]]
kind = "headings"
surface = "{surface}"
load = "{load}"
step_deg = {step}
speeds_m_s = {speeds}
distance_m = 0.6
"""
CURVES = """
[[runs]]
kind = "curves"
surface = "{surface}"
load = "{load}"
count = 2
speeds_m_s = [0.2]
distance_m = 0.6
"""


def driven(text: str, out: Path):
    """The plan of a config, driven below a folder."""
    made = plan(out / "site.toml", text)
    with Reporter(quiet=True) as report, Processes(os.cpu_count() or 1) as executor:
        simulate(made, out, executor, report)
    return made


def job_of(out: Path):
    """The identification job that the simulation wrote beside its logs."""
    path = out / "robot.toml"
    config = parsed(path, path.read_text(encoding="utf-8"))
    return read_fit_task(config, out / "logs", Reporter(quiet=True))


# speed


def test_speed_on_one_core() -> None:
    """Seconds of robot per second, by surface, and where the time goes."""
    print("\nsurface   times real time   us a step: engine  motors  floor")
    # in a process of its own: in this one every call's types are checked
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        for surface, (pace, parts) in zip(SURFACES, pool.map(_pace, SURFACES), strict=True):
            print(f"{surface:8}  {pace:10.1f}   " + "  ".join(f"{p:14.1f}" for p in parts))
            assert QUICK or pace > 4.0


def _pace(surface: str) -> tuple[float, list[float]]:
    """Best of three times real time, with sensors and files left out; and the profile."""
    run, paces = straight(surface, "as_built", 1.0, 0.2, 0.8), []
    for _ in range(quick(3, 1)):
        began = time.perf_counter()
        trace = drive(run, Site(), 0)
        paces.append(float(trace.time[-1]) / (time.perf_counter() - began))
    return max(paces), _profile(surface)


def _profile(surface: str) -> list[float]:
    """Microseconds a step of engine, motors and floor."""
    site = Site()
    run = straight(surface, "as_built", 1.0, 0.2, 0.5)
    plant = SimulatedRobot(site, run.map, "as_built")
    wanted = (site.robot.wheel_from_twist @ np.array([0.1, 0.1, 0.0])).tolist()
    spent = [0.0, 0.0, 0.0]
    engine, motors, look = plant._step, plant.drive.step, plant._look

    def timed(k, f):
        def run_it(*args):
            began = time.perf_counter()
            result = f(*args)
            spent[k] += time.perf_counter() - began
            return result

        return run_it

    plant._step, plant.drive.step = timed(0, engine), timed(1, motors)
    plant._look = timed(2, look)
    for _ in range(2000):
        plant.step(wanted)
    return [1e6 * s / 2000 for s in spent]


# identification


def test_left_out_sectors() -> None:
    """Six 60-degree sectors, each predicted by a fit that has not seen it on any floor."""
    text = "seed = 11\n" + "".join(
        HEADINGS.format(
            surface=s, load="as_built", step=quick(15, 60), speeds=quick([0.1, 0.2], [0.2])
        )
        for s in ("firm", "medium", "soft")
    )
    out = OUT / "sectors"
    driven(text, out)
    job = job_of(out)
    floors = compared(job.problem(), job.choices, job.dataset, "sectors", 6, quiet=True).floors
    print()
    for name, floor in floors.items():
        errors = {model: one.endpoint_error for model, one in floor.models.items()}
        mine = floor.models["identified"]
        print(f"{name}: " + ", ".join(f"{model} {e:.2%}" for model, e in errors.items()))
        print(
            f"{name}: {errors['encoder'] / mine.endpoint_error:.1f} times better than encoders, "
            f"90 % regions hold {mine.coverage90:.0%}"
        )
    soft = floors["soft"].models
    assert QUICK or soft["encoder"].endpoint_error > 4 * soft["identified"].endpoint_error


def _experiment(seed: int) -> dict:
    """One experiment with a robot of its own: estimates, stds and truths by name."""
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng([7, seed])
    resistance, back_emf = rng.uniform(4.5, 6.5), rng.uniform(0.045, 0.058)
    centres = [
        [float(v) for v in rng.uniform(0.004, 0.022) * np.array([np.cos(a), np.sin(a)])]
        for a in rng.uniform(-np.pi, np.pi, 2)
    ]
    text = (
        f"seed = {seed}\n[robot]\ncentres_m = {{ as_built = {centres[0]}, moved = {centres[1]} }}\n"
        f"[motor]\nresistance_ohm = {resistance}\nback_emf_vs = {back_emf}\n"
    )
    for load in ("as_built", "moved"):
        text += HEADINGS.format(surface="soft", load=load, step=quick(30, 90), speeds=[0.2])
        text += CURVES.format(surface="soft", load=load)
    text += HEADINGS.format(surface="firm", load="as_built", step=quick(60, 90), speeds=[0.2])
    out = OUT / "coverage" / f"seed{seed:02d}"
    made = driven(text, out)
    found = _fitted(job_of(out))
    known = truth(made.site)
    rows = {}
    for path, p in found.parameters.items():
        if path in known and not path.startswith("camera.") and p.verdict != "fixed":
            values = np.atleast_1d(p.value)
            for k, true in enumerate(np.atleast_1d(known[path]["value"])):
                low, high = p.interval90[k] if p.labels else p.interval90
                rows[f"{path}[{k + 1}]" if p.labels else path] = (
                    float(values[k]),
                    low,
                    high,
                    float(true),
                )
    return {"seed": seed, "converged": found.converged, "numbers": rows}


def _fitted(job):
    """What `identify` finds of a job, without the simpler models."""
    from slipid.fitting.optimise import optimise
    from slipid.infer.summary import summarise

    problem = job.problem()
    return summarise(problem, optimise(problem), job.dataset, job.choices)


def test_coverage_over_seeds() -> None:
    """R, C_e and load shares of robots drawn anew, every run with a floor and noise of its own."""
    found = []
    for seed in range(SEEDS):
        path = OUT / "coverage" / f"seed{seed:02d}.json"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(_experiment(seed)))
        found.append(json.loads(path.read_text()))
        print(f"  {seed + 1} of {SEEDS}", flush=True)
    names = list(found[0]["numbers"])
    print(f"\n{len(found)} experiments, {sum(f['converged'] for f in found)} converged")
    print(f"{'':30} mean error  rms error   largest   in 90 %   interval's half width")
    for name in names:
        value, low, high, true = np.array([f["numbers"][name] for f in found]).T
        relative = name.startswith("motor.")
        error = (value - true) / (true if relative else 1.0)
        inside = np.mean((low <= true) & (true <= high))
        half = np.mean(0.5 * (high - low) / (true if relative else 1.0))
        form = (lambda x: f"{100 * x:8.2f} %") if relative else (lambda x: f"{x:9.4f} ")
        print(
            f"{name:30} {form(error.mean())} {form(np.sqrt(np.mean(error**2)))} "
            f"{form(np.abs(error).max())} {100 * inside:6.0f} %   {form(half)}"
        )
    _power(found)
    for name in names:
        value, _, _, true = np.array([f["numbers"][name] for f in found]).T
        if name.startswith("motor."):
            assert QUICK or np.abs(value / true - 1).max() < 0.03


def _power(found: list[dict]) -> None:
    """As which power of the true loads wheels seem to carry, and what is left of the error then."""
    for load in ("as_built", "moved"):
        each = np.array(
            [[f["numbers"][f"robot.load_share@{load}[{k}]"] for k in (1, 2, 3)] for f in found]
        )
        seen, true = each[..., 0], each[..., 3]
        a, b = (np.log(x) - np.log(x).mean(axis=1, keepdims=True) for x in (seen, true))
        power = float(np.sum(a * b) / np.sum(b**2))
        acted = true**power / np.sum(true**power, axis=1, keepdims=True)
        rms, rest = (float(np.sqrt(np.mean((seen - x) ** 2))) for x in (true, acted))
        print(
            f"{load}: loads seem to act as their power {power:.2f}: rms error {rms:.4f}, "
            f"from that power {rest:.4f}"
        )


BIAS = {
    "soft": "",
    "no added forces": "compaction = 0\nbody_drag_n = 0",
    "shallow (1 mm)": "softness_m = 0.001",
    "stiff (shear 1e5 N/m)": "shear_n_m = 1e5",
}
CHANGES = quick(tuple(BIAS), ("soft",))
"""Names of those that are driven."""


def test_what_biases_load_shares() -> None:
    """Shares of one robot on floors that differ in one thing from `soft`."""
    print(f"\n{'floor':24} largest error of a share as built, moved   largest half width")
    for k, name in enumerate(CHANGES):
        text = f"seed = 5\n[surfaces.soft]\n{BIAS[name]}\n"
        for load in ("as_built", "moved"):
            text += HEADINGS.format(
                surface="soft", load=load, step=quick(30, 90), speeds=[0.1, 0.2]
            )
            text += CURVES.format(surface="soft", load=load)
        made = driven(text, OUT / "bias" / str(k))
        fit = _fitted(job_of(OUT / "bias" / str(k)))
        known = truth(made.site)
        errors, widths = [], []
        for load in ("as_built", "moved"):
            found = fit.parameters[f"robot.load_share@{load}"]
            true = known[f"robot.load_share@{load}"]["value"]
            errors.append(float(np.abs(np.array(found.value) - true).max()))
            widths.append(float(np.ptp(np.array(found.interval90), axis=1).max() / 2))
        print(f"{name:24} {errors[0]:24.3f} {errors[1]:14.3f} {max(widths):20.3f}", flush=True)
        if name == "soft":
            assert QUICK or max(errors) < 0.03


# the paper's observation


def test_currents_on_mixed_surfaces() -> None:
    """Wheels of a pair on two surfaces: does each draw the current of the floor beneath it?"""
    robot = replace(OmniBuild(), centres_m={"as_built": (0.0, 0.0)})
    site = Site(robot=robot)
    seeds = range(quick(6, 2))

    def currents(floor: FloorMap | None, surface: str | None, speed: float) -> np.ndarray:
        """Mean |current| of wheels 1 and 3, which x motion drives alike (seed, 2)."""
        program = TimedTwists((((speed, 0.0, 0.0), 3.0),))
        start = (-1.5 * speed, 0.0, 0.0)
        runs = [SiteRun(surface, "as_built", program, start, floor, "mixed") for _ in seeds]
        each = []
        for seed, run in zip(seeds, runs, strict=True):
            trace = drive(run, site, seed)
            steady = (trace.time > 1.0) & (trace.time < 2.5)
            each.append(np.abs(trace.current[steady][:, [0, 2]]).mean(axis=0))
        return np.array(each)

    print("\nA: wheel 1 on the first surface, wheel 3 on the second, wheel 2 on the border between")
    print(
        "surfaces       m/s   first alone  second alone  mixed: wheel 1  wheel 3   "
        "difference over that of the floors"
    )
    pairs = ("soft", "firm"), ("medium", "firm"), ("soft", "medium")
    for pair in quick(pairs, pairs[:1]):
        halves = FloorMap(pair, np.array([[1], [0]]), (-2.0, -2.0), 2.0)  # y > 0 is the first
        for speed in quick((0.1, 0.3), (0.3,)):
            first, second = (currents(None, s, speed).mean() for s in pair)
            both = currents(halves, None, speed)
            ratio = (both[:, 0] - both[:, 1]) / (first - second)
            error = ratio.std(ddof=1) / np.sqrt(len(ratio))
            # 1 if each drew the current of the floor beneath it
            assert QUICK or abs(ratio.mean()) < 0.5
            print(
                f"{pair[0]:7}{pair[1]:7} {speed:4.1f} {first:11.2f} {second:13.2f} "
                f"{both[:, 0].mean():14.2f} {both[:, 1].mean():9.2f} "
                f"{ratio.mean():12.2f} +- {error:.2f}"
            )


# pictures


def test_figures_beside_the_real_ones(real_data: Path) -> None:
    """Figures 2, 3, 4 and 7 and slip against heading, real on the left, test site on the right."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from slipid.data.reading.presets import preset
    from slipid.data.reading.reader import find_logs
    from slipid.lab.paper2021.plots import _floor
    from slipid.lab.paper2021.result import regenerate
    from tests.helpers.one_log import read_log

    OUT.mkdir(parents=True, exist_ok=True)
    real = regenerate(real_data / "robotino2021", None)
    site = Site(sensors=replace(Site().sensors, voltage=False))
    logs = _figure_logs(site)
    figure = Figure(figsize=(13, 24), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(5, 2)
    colours = {"gray": "#666666", "blue": "#0072B2", "red": "#D55E00"}
    colours |= {"table": "#999999", "brown": "#8a5a35", "green": "#1f6b45"}
    colours |= {"firm": "#E69F00", "short": "#8a5a35", "medium": "#666666", "soft": "#1f6b45"}
    # figure 2: the whole field
    for ax, (current, slip), title in (
        (axes[0, 0], (real.field.samples.current, real.field.samples.slip), "real whole site"),
        (axes[0, 1], _points(logs["site"])[:2], "test site, random patches"),
    ):
        ax.plot(current, slip, ".", ms=3, alpha=0.5, color="#56B4E9")
        ax.set(
            xlim=(0, 2.2),
            ylim=(0, 1),
            title=f"figure 2: {title}, motor 1",
            xlabel="current [A]",
            ylabel="slip",
        )
    # figures 3 and 4
    for row, what, limit in ((1, "current", 2.2), (2, "torque", 0.5)):
        for surface, part in real.motors[1].by_surface.items():
            axes[row, 0].plot(
                getattr(part, what),
                part.slip,
                ".",
                ms=3,
                alpha=0.4,
                color=colours[surface],
                label=surface,
            )
        for surface in ("firm", "medium", "soft"):
            current, slip, torque = _points(logs[surface])
            axes[row, 1].plot(
                current if what == "current" else torque,
                slip,
                ".",
                ms=3,
                alpha=0.4,
                color=colours[surface],
                label=surface,
            )
        for ax, where in zip(axes[row], ("real", "test site"), strict=True):
            unit = "current [A]" if what == "current" else "M [N m]"
            ax.set(
                xlim=(0, limit),
                ylim=(0, 1),
                xlabel=unit,
                ylabel="slip",
                title=f"figure {row + 2}: {where}, motor 1",
            )
            ax.legend(markerscale=3)
    # figure 7
    track = next(t for t in real.tracks if t.file.name == "encoders")
    axes[3, 0].plot(*_floor(track).T, lw=2, label="encoders only")
    for seed, trace in enumerate(logs["rectangle"]):
        label = "encoders only, six runs" if seed == 0 else None
        x, y = 1000 * trace.pose[:, :2].T
        axes[3, 1].plot(-y, x, lw=1.5, label=label, color="C0", alpha=0.6)
    for ax, where in zip(axes[3], ("real", "test site, four zones"), strict=True):
        ax.plot([0, 400, 400, 0, 0], [0, 0, 900, 900, 0], "k--", lw=1, label="commanded")
        ax.set(title=f"figure 7: {where}", xlabel="mm to the right", ylabel="mm ahead")
        ax.set_aspect("equal", adjustable="datalim")
        ax.legend(loc="upper right")
    # slip against heading
    slips: dict[str, np.ndarray] = {}
    folder = real_data / "robotino2022"
    for surface in ("table", "brown", "gray", "green"):
        paths = find_logs(folder, f"one_surface/{surface}/*.csv")
        seen = [read_log(p, preset("robotino2022"), root=folder, surface=surface) for p in paths]
        _by_heading(axes[4, 0], seen, colours[surface], surface)
    for surface in ("firm", "short", "medium", "soft"):
        slips[surface] = _by_heading(
            axes[4, 1], logs[f"{surface} headings"], colours[surface], surface
        )
    for ax, where in zip(axes[4], ("real 2022 logs", "test site, as built"), strict=True):
        ax.set(
            xlim=(0, 360),
            ylim=(-0.05, 0.7),
            xlabel="heading [deg]",
            ylabel="slip of the body",
            title=where,
        )
        ax.legend(loc="upper right", ncols=4)
    path = OUT / "beside_the_real_ones.png"
    figure.savefig(path, dpi=80)
    print(f"\n{path}")
    assert QUICK or 0.01 < np.median(slips["firm"]) < 0.03
    assert QUICK or 0.2 < np.median(slips["soft"]) < 0.5
    assert QUICK or np.ptp(slips["soft"]) > 0.15  # the load is off the middle


def _figure_logs(site: Site) -> dict:
    """Logs and traces for the figures."""
    floor = patchwork(["firm", "short", "medium", "soft"], seed=2)
    zones = four_zones(["firm", "medium", "soft", "short"])
    plans = {
        "site": WanderRuns(map="site", count=quick(12, 2)).runs(floor, 4),
        "rectangle": RectangleRuns(map="zones", repeats=quick(6, 1)).runs(zones, 0),
    }
    for surface in ("firm", "medium", "soft"):
        plans[surface] = PaperGridRuns(surface=surface).runs()[:: quick(1, 20)]
    for surface in ("firm", "short", "medium", "soft"):
        plan = HeadingRuns(
            surface=surface, step_deg=quick(10.0, 120.0), speeds_m_s=[0.2], distance_m=0.6
        )
        plans[f"{surface} headings"] = plan.runs()
    jobs = [(key, k, run) for key, runs in plans.items() for k, run in enumerate(runs)]
    out: dict = {key: [] for key in plans}
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        traces = pool.map(
            drive, [run for *_, run in jobs], [site] * len(jobs), [k for _, k, _ in jobs]
        )
        for (key, k, run), trace in zip(jobs, traces, strict=True):
            out[key].append(
                trace if key == "rectangle" else log_of(trace, site, run, f"{key}/{k}", k)
            )
    return out


def _points(logs: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Current, slip and torque variable M of motor 1 over half seconds, cut as the authors did."""
    from slipid.lab.paper2021.samples import FIGURES_3_AND_4, wheel_windows

    currents, slips, speeds = [], [], []
    for log in logs:
        seen = replace(log, pose=log.pose * [1.117, 1.117, 1.0])  # as the camera's scale is known
        current, slip = wheel_windows(seen, FIGURES_3_AND_4)
        currents.append(current[:, 0])
        slips.append(slip[:, 0])
        edges = np.linspace(0, log.samples - 1, len(current) + 1).astype(int)
        turned = np.abs(np.diff(log.wheel_angle[edges, 0])) / np.diff(log.time[edges])
        speeds.append(16 * turned)
    current, slip, speed = (np.concatenate(x) for x in (currents, slips, speeds))
    r = FIGURES_3_AND_4
    with np.errstate(divide="ignore", invalid="ignore"):
        torque = (r.back_emf * speed + r.resistance * current) * current / speed
        keep = (current > 0.25) & (slip > 0) & (slip <= 1) & (torque <= 0.5)
    return current[keep], slip[keep], torque[keep]


def _by_heading(ax, logs: list, colour: str, label: str) -> np.ndarray:
    """Draw the slip of the body against the direction of travel of every run; the slips."""
    back = np.linalg.pinv(OmniBuild().wheel_from_twist)
    way, slip = [], []
    for log in logs:
        far = back @ log.wheel_angle[-1]
        size = np.hypot(*far[:2])
        seen = 1.117 * np.hypot(*(log.pose[-1, :2] - log.pose[0, :2]))
        way.append(np.degrees(np.arctan2(far[1], far[0])) % 360)
        slip.append(1 - seen / size)
    ax.plot(way, slip, ".", color=colour, ms=5, label=label)
    return np.array(slip)
