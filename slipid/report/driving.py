"""What gains came to on the twin, and controllers on a rectangle."""

from pathlib import Path

from slipid.report.page import Page, table
from slipid.support.content import Content


def show_gains(page: Page, found: Content) -> None:
    """Write the content of gains.json."""
    gains = table(("gain", "value", "spread", "by hand", "unit"), right=("value", "spread"))
    hand = found["settings"]["hand"]
    for name, g in found["gains"].items():
        gains.add_row(name, f"{g['value']:.3f}", f"{g['spread']:.3f}", f"{hand[name]:g}", g["unit"])
    page.table(gains)
    loss, margin = found["loss"], found["stability_margin"]
    page.line(
        f"loss on {found['settings']['judged_on']} cases not tuned on: by hand {loss['hand']:.1f} "
        f"mm, tuned {loss['tuned']:.1f} mm; better in {found['better_than_hand']:.0%} of them"
    )
    page.line(
        f"stability margin (1 - spectral radius): worst {margin['worst']:.4f}, "
        f"median {margin['median']:.4f}"
    )


def show_trial(page: Page, found: Content, out: Path) -> None:
    """Write what every controller came to, medians over the starts."""
    numbers = ("closure", "cross-track", "first side", "heading", "path", "of encoders'")
    made = table(("controller", *numbers), right=numbers)
    for name, row in found["summary"].items():
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        told = "" if ratio is None else f"{100 * ratio['value']:.0f} % closure"
        if row["finished_share"] < 1:
            told += f", {100 * row['finished_share']:.0f} % of runs finished"
        made.add_row(
            name,
            f"{row['closure_error_median']:.0f} mm",
            f"{row['cross_track_rmse']:.0f} mm",
            f"{row['first_side_along_track_mm']:.0f} mm",
            f"{row['heading_error_deg']:.1f} deg",
            f"{row['path_length_mm']:.0f} mm",
            told,
        )
    page.table(made)
    best = found["closes_best"]
    page.line(f"closes best: {best} ({found['controllers'][best]})")
    count = min(row["runs"] for row in found["summary"].values())
    page.line(f"medians of {count} starts; 90 % intervals and every run: {out / 'trial.json'}")
    page.line(f"look at: {out / 'trial.png'}")
