"""Report of a camera calibration: plain values for the camera file, and text for people."""

import math
from collections.abc import Iterator

import numpy as np

from slipid.camera.calibration.lens import NAMES, rms
from slipid.camera.calibration.place import TWIN_RATIO, FloorFit, PlaceUncertainty, tilt_deg
from slipid.camera.calibration.quality import Quality
from slipid.camera.overhead import OverheadCamera
from slipid.support.content import Content

POOR_SCALE = 0.005
POOR_FLOOR_PX = 1.5
"""Relative std of lengths on the floor [1], and error of floor points in the image [pixel], above
which a camera is reported as poor."""
POINTS_SHOWN = 12
"""Number of points, those with the largest errors, that the text lists; the file lists all."""
UNITS = {"fx": " px", "fy": " px", "cx": " px", "cy": " px"}
"""Units of the lens parameters that have one, as text after the value."""


def lens_report(quality: Quality, left_out: list[str]) -> Content:
    """Return the report of a lens; `left_out` are sentences about unusable views."""
    fit, covered = quality.fit, quality.coverage
    views = [
        {"name": v.name, "corners": len(v.pixels), "rms_px": rms(r), "tilt_deg": t}
        for v, r, t in zip(fit.views, fit.residuals, quality.tilts_deg.tolist(), strict=True)
    ]
    numbers = {
        name: {"value": float(value), "std": float(std)}
        for name, value, std in zip(NAMES, fit.parameters, fit.std, strict=False)
    }
    return {
        "views": views,
        "left_out": [*left_out, *fit.left_out],
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


def floor_report(source: str, fit: FloorFit, spread: PlaceUncertainty, size_std: float) -> Content:
    """Return the report of a camera's pose above the floor, with lengths to check by tape.

    Args:
        source: description of where the points come from.
        fit: the fit of the pose.
        spread: uncertainty of the pose.
        size_std: relative std of the board's or tape's size [1].
    """
    keys = ("name", "pixel", "place_m", "off_px", "off_mm")
    columns = (fit.points.pixels, fit.points.places, fit.residuals, fit.off_mm)
    rows = zip(fit.points.names, *(column.tolist() for column in columns), strict=True)
    scale = float(np.hypot(spread.scale_std, size_std))
    return {
        "source": source,
        "rms_px": fit.rms_px,
        "points": [dict(zip(keys, row, strict=True)) for row in rows],
        "left_out": list(fit.left_out),
        "height_m": fit.camera.height,
        "height_std_m": float(np.hypot(spread.place_std_m[2], size_std * fit.camera.height)),
        "place_m": fit.camera.place.tolist(),
        "place_std_m": spread.place_std_m.tolist(),
        "tilt_deg": tilt_deg(fit.camera),
        "tilt_std_deg": spread.tilt_std_deg,
        "mm_per_pixel": mm_per_pixel(fit.camera),
        "pose_covariance": spread.pose.tolist(),
        "size_std": size_std,
        "scale_std": scale,
        "poor": _poor(fit, scale),
    }


def straight_report(camera: OverheadCamera) -> Content:
    """Return the report of a camera that was described by the user instead of calibrated."""
    return {
        "source": "described by the user: straight down, no distortion",
        "height_m": camera.height,
        "tilt_deg": 0.0,
        "mm_per_pixel": mm_per_pixel(camera),
        "left_out": [],
        "poor": [],
    }


def mm_per_pixel(camera: OverheadCamera) -> float:
    """Return the width of a pixel on the floor where the lens's axis meets it [mm]."""
    u, v = camera.lens.matrix[:2, 2]
    ends = camera.on_plane(np.array([[u - 0.5, v], [u + 0.5, v]]), 0.0)
    return float(1000 * np.linalg.norm(ends[1] - ends[0]))


def marker_height(height_m: float) -> str:
    """Return a sentence on the effect of a marker's height, for a camera at `height_m` [m]."""
    marker = 0.25 if height_m >= 1.5 else round(0.1 * height_m, 3)
    factor = height_m / (height_m - marker)
    return (
        f"a point h above the floor appears H / (H - h) times as far from the point below the "
        f"lens as it is: with H = {height_m:.3g} m and a marker {marker:g} m above the floor, "
        f"lengths would be {100 * (factor - 1):.1f} % too long if it were treated as lying on the "
        "floor: give its height to `slipid track`, and do not correct the height again"
    )


def _poor(fit: FloorFit, scale: float) -> list[str]:
    """Return sentences about shortcomings of a camera's pose above the floor."""
    poor = list(fit.left_out) if fit.disputed else []
    if fit.rms_px > POOR_FLOOR_PX and not poor:
        poor.append(
            f"points on the floor are off by {fit.rms_px:.1f} pixels; expected {POOR_FLOOR_PX:g} "
            "or less: check that the floor is flat, that the image was taken with this lens, and "
            "that all sizes are right"
        )
    if scale > POOR_SCALE:
        poor.append(
            f"lengths on the floor are known to {100 * scale:.2f} %; expected {100 * POOR_SCALE:g} "
            "% or better: measure more points all over the floor, or lay down a larger board"
        )
    if fit.twin_px is not None and fit.twin_px < TWIN_RATIO * fit.rms_px:
        poor.append(
            f"a second pose of the camera explains the points nearly as well (error "
            f"{fit.twin_px:.2f} pixels, this pose {fit.rms_px:.2f}): measure points that lie "
            "further apart"
        )
    return poor


def report_lines(report: Content, lens_too: bool = True) -> list[str]:
    """Return a camera file's report as lines of text; `lens_too` includes the lens's report."""
    lens, floor, poor = report.get("lens"), report.get("floor"), report.get("poor", [])
    lines = list(_lens(lens)) if lens and lens_too else []
    lines += _floor(floor) if floor else []
    lines += [f"note: {sentence}" for sentence in report.get("notes", [])]
    lines += [f"POOR: {sentence}" for sentence in poor]
    if not poor and (lens or (floor and "points" in floor)):
        lines.append("verdict: good")
    return lines


def _lens(lens: Content) -> Iterator[str]:
    """Yield the lines of a lens's report."""
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
        f"  corners in {100 * covered['share']:.0f} % of the image's cells, and at least "
        f"{100 * covered['reach']:.0f} % of the way to each image corner; tilts from "
        f"{min(tilts):.0f} to {max(tilts):.0f} degrees"
    )


def _floor(floor: Content) -> Iterator[str]:
    """Yield the lines of the report of a camera's pose above the floor."""
    yield f"pose above the floor: {floor['source']}"
    points = floor.get("points", [])
    shown = sorted(points, key=lambda p: -math.hypot(*p["off_px"]))[:POINTS_SHOWN]
    for point in points:
        if point in shown:
            u, v = point["off_px"]
            x, y = point["off_mm"]
            yield f"  {point['name']}: off by {u:+.2f}, {v:+.2f} px; {x:+.1f}, {y:+.1f} mm"
    if len(points) > POINTS_SHOWN:
        yield f"  the other {len(points) - POINTS_SHOWN} points are off by less"
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
        yield f"  the camera hangs above x = {x} m, y = {y} m of the floor"
        yield (
            f"  lengths on the floor are known to {100 * floor['scale_std']:.2f} %; the size of "
            f"board or tape contributes {100 * floor['size_std']:.2f} %"
        )
    yield (
        f"  check by tape: the lens hangs {floor['height_m']:.3f} m above the floor; where its "
        f"axis meets the floor, 100 pixels are {0.1 * floor['mm_per_pixel']:.4f} m"
    )
    yield f"  a marker's height: {marker_height(floor['height_m'])}"
