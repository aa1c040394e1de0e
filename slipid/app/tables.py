"""Results as tables for people, on stdout."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

COLOUR = {"identified": "green", "weak": "yellow", "not_identified": "red", "at_bound": "magenta"}


def _console() -> Console:
    found = Console(highlight=False)
    if not found.is_terminal:  # a file or a pipe has no width: do not wrap
        found = Console(highlight=False, width=140)
    return found


def _table(columns: Sequence[str], title: str | None = None, right: Sequence[str] = ()) -> Table:
    """Table without lines; the columns named in `right` are numbers."""
    table = Table(title=title, title_justify="left", show_edge=False, pad_edge=False, box=None)
    for name in columns:
        table.add_column(name, justify="right" if name in right else "left")
    return table


def _rows(e: Any) -> list[tuple[str, Any, Any]]:
    """Name, value and interval of a scalar, or of each entry of a vector."""
    if not e.labels:
        return [(e.path, e.value, e.interval90)]
    intervals = e.interval90 or [None] * len(e.labels)
    names = [e.path] + [""] * (len(e.labels) - 1)
    return [
        (f"{name} [{label}]".strip(), value, interval)
        for name, label, value, interval in zip(names, e.labels, e.value, intervals, strict=True)
    ]


def estimates(items: Iterable[Any], title: str) -> Table:
    """Table of estimates; numbers of single sessions and defaults are left to the files."""
    columns = ("parameter", "value", "unit", "90 % interval", "verdict", "from")
    table = _table(columns, title, right=("value",))
    for e in items:
        if "session_yaw" in e.path or (e.verdict == "fixed" and e.provenance == "borrowed"):
            continue
        colour = COLOUR.get(e.verdict, "dim")
        for k, (name, value, interval) in enumerate(_rows(e)):
            table.add_row(
                Text(name),
                f"{value:.4g}",
                e.unit,
                "" if interval is None else f"{interval[0]:.4g} .. {interval[1]:.4g}",
                "" if k else f"[{colour}]{e.verdict.replace('_', ' ')}[/{colour}]",
                "" if k else e.provenance,
            )
    return table


def identified(fit: Any, out: Path, written: Sequence[str], profiles: Sequence[Any] = ()) -> None:
    """What `identify` found."""
    console = _console()
    console.print(estimates(fit.parameters.values(), f"{len(fit.runs)} runs, {fit.rounds} rounds"))
    if fit.derived:
        console.print(estimates(fit.derived.values(), "\nknown as ratios, or not even so"))
    for p in profiles:
        console.print(f"profile: {p.said}", markup=False, soft_wrap=True)
    for sentence in fit.messages:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)
    state = "converged" if fit.converged else "NOT converged"
    console.print(f"{state}: {fit.reason}", markup=False, soft_wrap=True)
    console.print(f"in {out}: {', '.join(written)}", markup=False, soft_wrap=True)


def sampled(done: Any, out: Path) -> None:
    """What `sample` found."""
    console, about = _console(), done.about
    console.print(estimates(done.parameters.values(), f"{about['draws']} draws"))
    for sentence in done.content["messages"]:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)
    worst = about["worst"]
    console.print(
        f"{about['ensembles']} ensembles of {about['walkers']} walkers, {about['steps']} steps: "
        f"worst R-hat {worst['r_hat']:.4f}, {worst['steps_per_tau']:.0f} steps per "
        f"autocorrelation time, {worst['effective_draws']:.0f} effective draws"
    )
    state = "converged" if about["converged"] else "NOT converged, do not trust the intervals"
    more = "" if about["converged"] else "; a larger --most goes on from here"
    console.print(f"{state}: worst is {about['reason']}{more}", markup=False, soft_wrap=True)
    console.print(f"in {out}: {', '.join(done.written)}", markup=False, soft_wrap=True)


def check(found: dict[str, Any]) -> None:
    """What `check` found."""
    console = _console()
    table = _table(("surface", "load", "session", "runs", "minutes", "headings", "speeds [m/s]"))
    for row in found["groups"]:
        speeds = " ".join(f"{v:g}" for v in row["speeds"])
        table.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"]),
            speeds,
        )
    console.print(table)
    console.print("channels: " + ", ".join(found["channels"]), markup=False, soft_wrap=True)
    for note, count in found["notes"].items():
        console.print(f"repaired in {count} runs: {note}", markup=False, soft_wrap=True)
    before = _table(
        ("parameter", "unit", "std after / before", "verdict"),
        "before any fit: what the logs can be expected to tell",
    )
    for path, e in (found["parameters"] | found["derived"]).items():
        if e["ratio"] is None or "session_yaw" in path:
            continue
        colour = COLOUR.get(e["verdict"], "dim")
        verdict = f"[{colour}]{e['verdict'].replace('_', ' ')}[/{colour}]"
        before.add_row(Text(path), e["unit"], f"{e['ratio']:.3f}", verdict)
    console.print(before)
    for sentence in found["messages"]:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)


RECOVERED = {"yes": "green", "roughly": "yellow", "no": "red", "wrong": "magenta"}


def selftest(found: dict[str, Any], out: Path) -> None:
    """What `selftest` found."""
    console = _console()
    table = _table(
        ("parameter", "unit", "error", "of truth", "z rms", "in 90 %", "verdict", "recovered"),
        f"{found['replicates']} made experiments like this one ({found['runs']} runs), "
        f"{found['converged']} fits converged",
    )
    for path, e in found["parameters"].items():
        colour = RECOVERED[e["recovered"]]
        share = None if e["recovered"] == "no" else e["relative_error_rms"]
        table.add_row(
            Text(path),
            e["unit"],
            f"{e['error_rms']:.2g}",
            "" if share is None else f"{100 * share:.1f} %",
            f"{e['z_rms']:.2f}",
            f"{round(e['coverage90'] * e['intervals'])} of {e['intervals']}",
            e["verdict"].replace("_", " "),
            f"[{colour}]{e['recovered']}[/{colour}]" + (" *" if path in found["wanted"] else ""),
        )
    console.print(table)
    console.print("* wanted; wrong: errors larger than the fits say\n", soft_wrap=True)
    floors = _table(
        ("surface", "slip curve off by", "at most", "in its band", "prediction off by", "encoders")
    )
    for floor, c in found["curves"].items():
        p = found["predictions"].get(floor, {})
        floors.add_row(
            floor,
            f"{c['median_gap']:.4f}",
            f"{c['largest_gap']:.4f}",
            _percent(c["coverage90"]),
            _percent(p.get("identified")),
            _percent(p.get("encoder")),
        )
    console.print(floors)
    for sentence in found["messages"]:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)
    if found["failed"]:
        console.print(f"NOT recovered: {', '.join(found['failed'])}", markup=False, soft_wrap=True)
    console.print(f"in {out}: selftest.json, replicates.json", markup=False, soft_wrap=True)


def validation(found: dict[str, Any]) -> None:
    """Summary of a validation: one row per floor and model."""
    columns = ("surface", "model", "end-point error", "median", "length", "heading")
    table = _table((*columns, "in 90 %", "runs"))
    for surface, models in found["summary"].items():
        for model, s in models.items():
            table.add_row(
                surface,
                model,
                _percent(s["endpoint_error_mean"]),
                _percent(s["endpoint_error_median"]),
                _percent(s["length_error_mean"]),
                ""
                if s["heading_error_median_deg"] is None
                else f"{s['heading_error_median_deg']:.2f} deg",
                _percent(s["coverage90"]),
                str(s["runs"]),
            )
    _console().print(table)


def comparison(found: dict[str, Any]) -> None:
    """Every question: a line per model, a column per floor, then a sentence per floor."""
    console = _console()
    for question, answer in found["questions"].items():
        floors, cost = answer["floors"], answer["cost"]
        console.print(
            f"{question} left out: log density less the best's ± clustered standard error (nats "
            "per run), mean end-point error (%), ends in the 90 % region (%)",
            markup=False,
            soft_wrap=True,
        )
        table = Table(show_edge=False, pad_edge=False, box=None)
        table.add_column("model", no_wrap=True)
        for floor, one in floors.items():
            table.add_column(Text(f"{floor} ({one['runs']})"), justify="right", no_wrap=True)
        table.add_column("numbers", justify="right", no_wrap=True)
        table.add_column("fit [s]", justify="right", no_wrap=True)
        for model, spent in cost.items():
            cells = [_judged(one["models"][model]) for one in floors.values()]
            table.add_row(model, *cells, _numbers(spent["numbers"]), f"{spent['fit_s']:.1f}")
        console.print(table)
        for one in floors.values():
            console.print(one["sentence"], markup=False, soft_wrap=True)
            missed = [
                f"{model} {100 * m['coverage90']:.0f}"
                for model, m in one["models"].items()
                if not one["band90"][0] <= m["coverage90"] <= one["band90"][1]
            ]
            if missed:
                low, high = (f"{100 * x:.0f}" for x in one["band90"])
                said = f"  not in {low} to {high} %, where honest 90 % regions hold ends: "
                console.print(said + ", ".join(missed), markup=False, soft_wrap=True)
        console.print()
    if found["surfaces"]:
        one = found["surfaces"]["all"]
        console.print(
            "slip of a floor that was not fitted, root mean square over floors: one curve of "
            f"current {one['pooled']['floors']:.3f}, a constant {one['constant']['floors']:.3f}, "
            f"the floor's own curve {one['per_surface']['floors']:.3f}",
            soft_wrap=True,
        )
    loo = found["loo"]
    if "elpd" in loo:
        off = max(abs(e["psis"] - e["exact"]) for e in loo["exact"])
        console.print(
            f"contact equilibrium with one run left out (PSIS-LOO): {loo['elpd']:.2f} nats per "
            f"run, Pareto k up to {loo['pareto_k_max']:.2f} ({loo['unreliable']} above "
            f"{loo['good_k']:.2f}); off by at most {off:.2f} where checked by a fit without it",
            soft_wrap=True,
        )


def _judged(m: dict[str, Any]) -> str:
    colour = {"best": "bold green", "tied": "green"}.get(m["verdict"], "default")
    se = m["se_clustered"]
    if m["verdict"] == "best":
        apart = "best"
    else:
        apart = f"{m['difference']:.1f} ± {'?' if se is None else format(se, '.1f')}"
    far, inside = 100 * m["endpoint_error"], 100 * m["coverage90"]
    return f"[{colour}]{apart}[/{colour}] {far:5.1f} {inside:3.0f}"


def _numbers(count: dict[str, int]) -> str:
    """Fitted numbers of a floor, and of all floors together."""
    floors = sorted({n for floor, n in count.items() if floor != "shared"})
    own = f"{floors[0]}" if len(floors) == 1 else f"{floors[0]}-{floors[-1]}"
    return f"{own} + {count['shared']}" if count["shared"] else own


SHOWN = 3
"""Goals that have a column of their own."""


def design(found: dict[str, Any], out: Path, written: Sequence[str]) -> None:
    """Runs to drive next, what they shrink, and what they save."""
    console = _console()
    goals = [g for g in found["goals"] if g["reachable"]][:SHOWN]
    if found["runs"]:
        table = Table(show_edge=False, pad_edge=False, box=None)
        for name in ("run", "floor", "load", "heading", "m/s", "turn", "m", "seconds"):
            table.add_column(name, justify="left" if name in ("floor", "load") else "right")
        for g in goals:
            table.add_column(Text(f"{g['name']} [{g['unit']}]"), justify="right")
        before = [_uncertain(g["now"], g["unit"]) for g in goals]
        table.add_row("", "now", *[""] * 6, *before)
        for k, run in enumerate(found["runs"], 1):
            table.add_row(
                str(k),
                Text(run["floor"]),
                Text(run["load"]),
                f"{run['heading_deg']:.0f} deg" if run["speed"] else "",
                f"{run['speed']:g}" if run["speed"] else "",
                f"{math.degrees(run['turn_rate']):.0f} deg/s" if run["turn_rate"] else "",
                f"{run['distance']:.2g}",
                f"{run['seconds']:.1f}",
                *(_uncertain(run["expected"][g["name"]], g["unit"]) for g in goals),
            )
        console.print(table)
        rest = len([g for g in found["goals"] if g["reachable"]]) - len(goals)
        if rest:
            console.print(f"std after each run; {rest} more goals are in design.json")
        else:
            console.print("std after each run")
    for s in found["runs_saved"].values():
        console.print(_saving(s), markup=False, soft_wrap=True)
    for sentence in found["messages"]:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)
    console.print(f"in {out}: {', '.join(written)}", markup=False, soft_wrap=True)


def _uncertain(std: float, unit: str) -> str:
    return f"{100 * std:.3g} %" if unit == "m/m" else f"{std:.3g}"


def _saving(s: dict[str, Any]) -> str:
    """One sentence on runs saved."""
    whole = f"{s['name']} ({s['grid_runs']} runs)"
    if s["greedy_runs"] is None:
        return f"from nothing: no fewer chosen runs tell as much as {whole}"
    worse = s["criterion_random_order"] / s["criterion"]
    return (
        f"from nothing: {s['greedy_runs']} chosen runs tell as much as {whole}: {s['ratio']:.0%}; "
        f"the first {s['greedy_runs']} of it in random order leave {worse:.2g} times the variance"
    )


def tuned(found: dict[str, Any], out: Path) -> None:
    """Gains, what they bring on cases they were not tuned on, and how stable the loop is."""
    console = _console()
    table = _table(("gain", "value", "spread", "by hand", "unit"), right=("value", "spread"))
    hand = found["settings"]["hand"]
    for name, g in found["gains"].items():
        row = (f"{g['value']:.3f}", f"{g['spread']:.3f}", f"{hand[name]:g}", g["unit"])
        table.add_row(name, *row)
    console.print(table)
    loss, margin = found["loss"], found["stability_margin"]
    console.print(
        f"loss on {found['settings']['judged_on']} cases not tuned on: by hand {loss['hand']:.1f} "
        f"mm, tuned {loss['tuned']:.1f} mm; better in {found['better_than_hand']:.0%} of them"
    )
    console.print(
        f"stability margin (1 - spectral radius): worst {margin['worst']:.4f}, "
        f"median {margin['median']:.4f}"
    )
    console.print(f"in {out}: gains.json", markup=False, soft_wrap=True)


def simulated(found: dict[str, Any], plan: Any, out: Path) -> None:
    """How much was driven, and what to do with it."""
    from slipid.app.simulate import can_identify

    console = _console()
    console.print(f"{len(found['runs'])} runs, {found['driven']} of them driven now")
    if found["pace"] is not None:
        console.print(f"{found['seconds']:.0f} s at {found['pace']:.1f} times real time")
    console.print(f"truth, which nothing reads that fits: {out / 'truth'}", soft_wrap=True)
    if can_identify(plan):
        line = (
            f"  slipid identify {out / 'robot.toml'} --data {out / 'logs'} --out {out / 'result'}"
        )
        console.print(line, markup=False, soft_wrap=True)
    if "robotino2022" in plan.content.formats:
        data = out / "robotino2022"
        line = (
            f"  slipid identify configs/robotino2022.toml --data {data} --out {out / 'result2022'}"
        )
        console.print(line, markup=False, soft_wrap=True)


def trial(found: dict[str, Any], out: Path) -> None:
    """What every controller came to, medians over the starts."""
    console = _console()
    heads = (
        "controller",
        "closure",
        "cross-track",
        "first side",
        "heading",
        "path",
        "of encoders'",
    )
    table = _table(heads, right=heads[1:])
    for name, row in found["summary"].items():
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        told = "" if ratio is None else f"{100 * ratio['value']:.0f} % closure"
        if row["finished_share"] < 1:
            told += f", {100 * row['finished_share']:.0f} % of runs finished"
        table.add_row(
            name,
            f"{row['closure_error_median']:.0f} mm",
            f"{row['cross_track_rmse']:.0f} mm",
            f"{row['first_side_along_track_mm']:.0f} mm",
            f"{row['heading_error_deg']:.1f} deg",
            f"{row['path_length_mm']:.0f} mm",
            told,
        )
    console.print(table)
    best = found["closes_best"]
    console.print(f"closes best: {best} ({found['controllers'][best]})", soft_wrap=True)
    count = min(row["runs"] for row in found["summary"].values())
    console.print(f"medians of {count} starts; 90 % intervals and every run: {out / 'trial.json'}")
    console.print(f"look at: {out / 'trial.png'}", soft_wrap=True)


def demo(
    out: Path, done: Any, found: dict[str, Any], rows: Sequence[Any], real: Path | None
) -> None:
    """Truth against estimate, prediction of unseen runs, and where to look."""
    console = _console()
    columns = ("parameter", "truth", "identified", "unit", "90 % interval", "truth in it", "")
    table = _table(columns, right=("truth", "identified"))
    for r in rows:
        colour = COLOUR.get(r.verdict, "dim")
        table.add_row(
            Text(f"{r.path} [{r.label}]" if r.label else r.path),
            f"{r.truth:.4g}",
            f"{r.value:.4g}",
            r.unit,
            f"{r.interval[0]:.4g} .. {r.interval[1]:.4g}",
            "yes" if r.inside else "no",
            f"[{colour}]{r.verdict.replace('_', ' ')}[/{colour}]",
        )
    console.print(table)
    inside = sum(r.inside for r in rows)
    console.print(
        f"{inside} of {len(rows)} intervals hold the truth: the logs come from another physics "
        "(MuJoCo's rollers) than the model's, and intervals know nothing of that\n"
    )
    console.print("runs it has not seen, predicted open loop:")
    validation(found)
    result = out / "result"
    pictures = [result / name for name in done.written if name.endswith(".png")]
    pictures += sorted(result.glob("validation_*.png"))
    console.print(f"\nlook at: {', '.join(map(str, pictures))}")
    console.print(f"numbers: {result / 'identified.json'}, {result / 'validation.json'}")
    if real is not None:
        data = real / "robotino2022"
        console.print("real logs are here; on them:", markup=False)
        line = f"  slipid identify configs/robotino2022.toml --data {data} --out out/robotino2022"
        console.print(line, markup=False, soft_wrap=True)
        line = f"  slipid validate out/robotino2022 --data {data}"
        console.print(line, markup=False, soft_wrap=True)


def _percent(x: float | None) -> str:
    return "" if x is None else f"{100 * x:.2f} %"


def _degrees(x: float | None) -> str:
    return "" if x is None else f"{x:.2f} deg"
