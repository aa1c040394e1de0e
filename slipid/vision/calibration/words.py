"""The report of a calibration as lines of text."""

import math
from collections.abc import Iterator

from slipid.support.content import Content
from slipid.vision.calibration.report import marker_height

SHOWN = 12
"""Points that are listed, those that are furthest off; the file has all."""
UNITS = {"fx": " px", "fy": " px", "cx": " px", "cy": " px"}


def described(report: Content, lens_too: bool = True) -> list[str]:
    """What a camera file's report says, for people; of the lens where it is news."""
    lens, floor, poor = report.get("lens"), report.get("floor"), report.get("poor", [])
    lines = [*_lens(lens)] if lens and lens_too else []
    lines += [*_floor(floor)] if floor else []
    lines += [f"POOR: {sentence}" for sentence in poor]
    if not poor and (lens or (floor and "points" in floor)):
        lines.append("verdict: good")
    return lines


def _lens(lens: Content) -> Iterator[str]:
    views, covered = lens["views"], lens["coverage"]
    corners = sum(view["corners"] for view in views)
    tilts = [view["tilt_deg"] for view in views]
    yield f"lens from {len(views)} views of {lens['board']}"
    for view in views:
        yield (
            f"  {view['name']}: {view['corners']} corners, error {view['rms_px']:.3f} px, tilt "
            f"{view['tilt_deg']:.0f} degrees"
        )
    yield from (f"  {sentence}" for sentence in lens["left_out"])
    for name, number in lens["numbers"].items():
        shown = ".2f" if name in UNITS else ".5f"
        yield f"  {name} = {number['value']:{shown}} ± {number['std']:{shown}}{UNITS.get(name, '')}"
    yield (
        f"  error of {corners} corners {lens['rms_px']:.3f} px rms; on views held out of the fit "
        f"{lens['held_out_rms_px']:.3f} px"
    )
    yield (
        f"  corners in {100 * covered['share']:.0f} % of the picture's cells, and "
        f"{100 * covered['reach']:.0f} % of the way to its corners or more; tilts from "
        f"{min(tilts):.0f} to {max(tilts):.0f} degrees"
    )


def _floor(floor: Content) -> Iterator[str]:
    yield f"place above the floor: {floor['source']}"
    points = floor.get("points", [])
    shown = sorted(points, key=lambda p: -math.hypot(*p["off_px"]))[:SHOWN]
    for point in points:
        if point in shown:
            u, v = point["off_px"]
            x, y = point["off_mm"]
            yield f"  {point['name']}: off by {u:+.2f}, {v:+.2f} px; {x:+.1f}, {y:+.1f} mm"
    if len(points) > SHOWN:
        yield f"  the other {len(points) - SHOWN} points are off by less"
    yield from (f"  {sentence}" for sentence in floor["left_out"])
    if points:
        yield (
            f"  error {floor['rms_px']:.3f} px rms; camera {floor['height_m']:.3f} ± "
            f"{floor['height_std_m']:.3f} m above the floor, its axis {floor['tilt_deg']:.2f} ± "
            f"{floor['tilt_std_deg']:.2f} degrees off straight down"
        )
        x, y = (
            f"{at:.3f} ± {std:.3f}"
            for at, std in zip(floor["place_m"][:2], floor["place_std_m"][:2], strict=True)
        )
        yield f"  it hangs above x = {x} m, y = {y} m of the floor"
        yield (
            f"  lengths on the floor are known to {100 * floor['scale_std']:.2f} %, of which the "
            f"size of board or tape {100 * floor['size_std']:.2f} %"
        )
    yield (
        f"  check by tape: the lens hangs {floor['height_m']:.3f} m above the floor; where its "
        f"axis meets the floor, 100 pixels are {0.1 * floor['mm_per_pixel']:.4f} m"
    )
    yield f"  a marker's height: {marker_height(floor['height_m'])}"
