"""Slip models judged on left-out runs, as a table per question."""

from rich.table import Table
from rich.text import Text

from slipid.report.page import Page, table
from slipid.support.content import Content


def show_comparison(page: Page, found: Content) -> None:
    """Write the content of comparison.json: a line per model, a column per floor, sentences."""
    for question, answer in found["questions"].items():
        page.line(
            f"{question} left out: log density less the best's ± clustered standard error (nats "
            "per run), mean end-point error (%), ends in the 90 % region (%)"
        )
        page.table(_ladder(answer))
        for one in answer["floors"].values():
            page.line(one["sentence"])
            low, high = one["band90"]
            missed = [
                f"{model} {100 * m['coverage90']:.0f}"
                for model, m in one["models"].items()
                if not low <= m["coverage90"] <= high
            ]
            if missed:
                page.line(
                    f"  not in {100 * low:.0f} to {100 * high:.0f} %, where honest 90 % regions "
                    f"hold ends: {', '.join(missed)}"
                )
        page.line()
    if found["surfaces"]:
        one = found["surfaces"]["all"]
        page.line(
            "slip of a floor that was not fitted, root mean square over floors: one curve of "
            f"current {one['pooled']['floors']:.3f}, a constant {one['constant']['floors']:.3f}, "
            f"the floor's own curve {one['per_surface']['floors']:.3f}"
        )


def _ladder(answer: Content) -> Table:
    """Table of one question."""
    floors = answer["floors"]
    made = table(())
    made.add_column("model", no_wrap=True)
    for name in (*(f"{floor} ({one['runs']})" for floor, one in floors.items()), "numbers"):
        made.add_column(Text(name), justify="right", no_wrap=True)
    made.add_column("fit [s]", justify="right", no_wrap=True)
    for model, spent in answer["cost"].items():
        cells = [_judged(one["models"][model]) for one in floors.values()]
        made.add_row(model, *cells, _numbers(spent["numbers"]), f"{spent['fit_s']:.1f}")
    return made


def _judged(m: Content) -> str:
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
