"""Every model's error side by side."""

from collections.abc import Mapping

from slipid.plots import drawing
from slipid.plots.drawing import Axes, Figure
from slipid.support.content import Content

WORDS = {
    "identified": "identified (force balance)",
    "encoder": "encoders alone",
    "constant": "one slip for all",
    "linear": "slip ~ torque",
    "affine": "slip ~ 1 + torque",
    "svr": "slip ~ 1 + torque, SVR",
    "quadratic": "slip ~ 1 + torque + torque²",
    "saturating": "slip ~ saturating torque",
    "monotone_spline": "slip ~ any rising curve of torque",
    "affine_current": "slip ~ 1 + current",
    "heading_lookup": "lookup by heading",
    "paper": "form of 2021, refitted",
}


def ladder_figure(found: Content, which: str) -> Figure:
    """Mean end-point error of every model on every floor, a bar each.

    Args:
        found: content of a validation file.
        which: runs these are, in words.
    """
    floors = found["summary"]
    models = list(next(iter(floors.values())))
    width = 2.7 * len(floors) + 2.4
    made = drawing.figure(
        max(width, 8.8),
        1.7 + 0.32 * len(models),
        f"How far from the camera's end each model ends, open loop; {which}",
    )
    axes = made.subplots(1, len(floors), sharey=True, squeeze=False)[0]
    for ax, (floor, by) in zip(axes, floors.items(), strict=True):
        _bars(ax, {model: 100 * by[model]["endpoint_error_mean"] for model in models})
        name = floor.replace("@", ", load ")
        ax.set_title(f"{name}\n{by[models[0]]['runs']} runs", fontsize=10)
        ax.set_xlabel("mean end-point error\n[% of the camera's displacement]")
    axes[0].set_yticks(range(len(models)), [WORDS.get(m, m.replace("_", " ")) for m in models])
    axes[0].invert_yaxis()
    return made


def _bars(ax: Axes, error: Mapping[str, float]) -> None:
    drawing.plain(ax)
    ax.grid(False, axis="y")
    colours = [drawing.BLUE if model == "identified" else "#bbbbbb" for model in error]
    values = list(error.values())
    bars = ax.barh(range(len(values)), values, color=colours, height=0.75)
    ax.bar_label(bars, [f"{v:.1f}" for v in values], padding=3, fontsize=9)
    ax.set_xlim(0.0, 1.2 * max(values))
