"""Tables of calibrated kinematics, and the verdict of trust with the errors behind it."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from slipid.fitting.calibration.result import Calibration
from slipid.report.numbers import interval, rounded
from slipid.report.page import Page, counted, heading, percent, table, verdict

if TYPE_CHECKING:
    from slipid.fitting.calibration.result import Value
    from slipid.infer.verdicts.trust import Trust


def show_calibration(page: Page, found: Calibration) -> None:
    """Write calibrated lengths, floor by floor, and the place of the pose sensor."""
    every = calibrated_values(found)
    page.table(_table(every))
    by: dict[str, list[str]] = {}
    for group, rows in every.items():
        for name, value in rows.items():
            by.setdefault(value.verdict, []).append(f"{group} {name}")
    good = len(by.pop("identified", ()))
    by.pop("fixed", None)
    count = good + sum(map(len, by.values()))
    rest = [f"; {word.replace('_', ' ')}: {counted(names)}" for word, names in by.items()]
    page.line(f"{good} of {count} calibrated numbers are identified{''.join(rest)}")
    for floor, (radius, base) in found.multipliers.items():
        each = " ".join(f"{r:.4f}" for r in radius)
        page.line(
            f"multipliers of the config's lengths on {floor}: radius {each}, "
            f"{found.length} {base:.4f}"
        )


def calibrated_values(found: Calibration) -> "dict[str, dict[str, Value]]":
    """Return the calibrated numbers by name, keyed by floor or by what they belong to."""
    every: dict[str, dict[str, Value]] = {}
    for floor, radii in found.radius.items():
        drives = found.drives(radii).items()
        every[floor] = {f"rolling radius {side}": value for side, value in drives}
        every[floor][f"effective {found.length}"] = found.base[floor]
        if floor in found.centre:
            every[floor]["centre of rotation ahead"] = found.centre[floor]
    if found.steering:
        names = [name for name in found.steering if name != "wheelbase_m"]
        every["steering"] = {name.removesuffix("_rad"): found.steering[name] for name in names}
    ahead, left = found.offset
    pose = {"ahead": ahead, "to the left": left, "yaw": found.yaw, "lag": found.lag}
    if found.scale.verdict != "fixed":
        pose["true over logged length"] = found.scale
    every["pose sensor"] = pose
    if found.gyro:
        every["gyro"] = {
            name.removeprefix("gyro_").removesuffix("_rad_s"): value
            for name, value in found.gyro.items()
        }
    return every


def _table(every: "Mapping[str, Mapping[str, Value]]") -> Table:
    made = table(("calibration", "value", "unit", "90 % interval", "verdict"), right=("value",))
    for group, rows in every.items():
        heading(made, group)
        for name, value in rows.items():
            factor, unit = (1e3, "mm") if value.unit == "m" else (1.0, value.unit)
            low, high = (factor * end for end in value.interval90)
            made.add_row(
                Text(f"  {name}"),
                rounded(factor * value.value, high - low),
                unit,
                "" if value.verdict == "fixed" else interval((low, high)),
                verdict(value.verdict),
            )
    return made


def show_trust(page: Page, found: "Trust") -> None:
    """Write the errors of slip models on held-out runs, the selected ones, and the verdict."""
    if found.floors:
        every = all(floor.held_out for floor in found.floors.values())
        models = list(next(iter(found.floors.values())).errors)
        made = table(
            ("surface", *models, "selected", "runs"),
            f"\nerrors of {'held-out' if every else 'held-out or single'} runs, over their path "
            "length",
            (*models, "runs"),
        )
        for name, floor in found.floors.items():
            each = (percent(floor.errors[m]) for m in models)
            made.add_row(Text(name), *each, floor.model, str(floor.runs))
        page.table(made)
        page.line("open loop, without a pose but the first; mean over the run and its halves")
    page.notes(found.notes, first=True)
    page.line(f"verdict: {found}")
