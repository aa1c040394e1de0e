"""What a calibration found, as plain values for the camera file and for people.

The report of a calibration as lines of text.
"""

import math
from collections.abc import Iterator

import numpy as np

from slipid.camera.calibration.lens import NAMES, LensFit, rms
from slipid.camera.calibration.place import TWIN_RATIO, FloorFit, Spread, tilt_deg
from slipid.camera.calibration.quality import Quality
from slipid.camera.overhead import OverheadCamera
from slipid.support.content import Content

POOR_SCALE = 0.005
POOR_FLOOR_PX = 1.5


def lens_report(fit: LensFit, quality: Quality, dropped: list[str]) -> Content:
    """Of a lens."""
    covered = quality.coverage
    views = [
        {"name": v.name, "corners": len(v.pixels), "rms_px": rms(r), "tilt_deg": t}
        for v, r, t in zip(fit.views, fit.residuals, quality.tilts_deg.tolist(), strict=True)
    ]
    numbers = {
        name: {"value": float(value), "std": float(std)}
        for name, value, std in zip(NAMES, fit.numbers, fit.std, strict=False)
    }
    return {
        "views": views,
        "left_out": dropped,
        "rms_px": fit.rms_px,
        "held_out_rms_px": quality.held_out_px,
        "numbers": numbers,
        "covariance": fit.covariance.tolist(),
        "coverage": {
            "share": covered.share,
            "reach": covered.reach,
            "cells": covered.visited.astype(int).tolist(),
        },
        "poor": quality.poor,
    }


def floor_report(source: str, fit: FloorFit, found: Spread, size_std: float) -> Content:
    """Of a camera's place above the floor, with what a person can check by tape."""
    points = [
        {
            "name": name,
            "pixel": pixel.tolist(),
            "place_m": place.tolist(),
            "off_px": off.tolist(),
            "off_mm": mm.tolist(),
        }
        for name, pixel, place, off, mm in zip(
            fit.points.names,
            fit.points.pixels,
            fit.points.places,
            fit.residuals,
            fit.off_mm,
            strict=True,
        )
    ]
    scale = scale_std(found, size_std)
    return {
        "source": source,
        "rms_px": fit.rms_px,
        "points": points,
        "left_out": fit.told,
        "height_m": fit.camera.height,
        "height_std_m": float(np.hypot(found.place_std_m[2], size_std * fit.camera.height)),
        "place_m": fit.camera.place.tolist(),
        "place_std_m": found.place_std_m.tolist(),
        "tilt_deg": tilt_deg(fit.camera),
        "tilt_std_deg": found.tilt_std_deg,
        "mm_per_pixel": mm_per_pixel(fit.camera),
        "pose_covariance": found.pose.tolist(),
        "size_std": size_std,
        "scale_std": scale,
        "poor": _poor(fit, scale),
    }


def straight_report(camera: OverheadCamera) -> Content:
    """Of a camera that nobody calibrated."""
    return {
        "source": "told: straight down, no distortion",
        "height_m": camera.height,
        "tilt_deg": 0.0,
        "mm_per_pixel": mm_per_pixel(camera),
        "left_out": [],
        "poor": [],
    }


def scale_std(found: Spread, size_std: float) -> float:
    """Of lengths on the floor, relative: the pose's part and that of the known lengths' size."""
    return float(np.hypot(found.scale_std, size_std))


def mm_per_pixel(camera: OverheadCamera) -> float:
    """Distance on the floor between neighbouring pixels where the lens' axis meets it."""
    u, v = camera.lens.matrix[:2, 2]
    ends = camera.on_plane(np.array([[u - 0.5, v], [u + 0.5, v]]), 0.0)
    return float(1000 * np.linalg.norm(ends[1] - ends[0]))


def marker_height(height_m: float) -> str:
    """What a marker's height does to lengths, for a camera at a height."""
    marker = 0.25 if height_m >= 1.5 else round(0.1 * height_m, 3)
    factor = height_m / (height_m - marker)
    return (
        f"what lies h above the floor appears H / (H - h) times as far from the point below the "
        f"lens as it is: with H = {height_m:.3g} m and a marker {marker:g} m up, lengths would "
        f"come out {100 * (factor - 1):.1f} % too long if it were read on the floor: read it with "
        "its height, and correct nothing twice"
    )


def _poor(fit: FloorFit, scale: float) -> list[str]:
    found = list(fit.told) if fit.disputed else []
    if fit.rms_px > POOR_FLOOR_PX and not found:
        found.append(
            f"points on the floor are off by {fit.rms_px:.1f} pixels; expected {POOR_FLOOR_PX:g} "
            "or less: is the floor flat, is this lens that of the picture, are sizes right?"
        )
    if scale > POOR_SCALE:
        found.append(
            f"lengths on the floor are known to {100 * scale:.2f} %; expected {100 * POOR_SCALE:g} "
            "% or better: measure more points all over the floor, or lay down a larger board"
        )
    if fit.twin_px is not None and fit.twin_px < TWIN_RATIO * fit.rms_px:
        found.append(
            f"a second place of the camera explains the points nearly as well ({fit.twin_px:.2f} "
            f"pixels, this one {fit.rms_px:.2f}): measure points that lie further apart"
        )
    return found


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
