"""`slipid map`: make a map of the surfaces of a floor from a picture taken from above."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Json, Next, Out, Quiet, can_draw, emit, guarded, option
from slipid.support.errors import DataError
from slipid.support.folder import locked
from slipid.support.progress import Reporter
from slipid.support.quantities import Height

if TYPE_CHECKING:
    from slipid.camera.floor.result import PictureMap
    from slipid.report.page import Page

PROPOSAL = "palette.toml"


@guarded
def map_(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="Picture or video of the floor.")],
    out: Out,
    camera: Annotated[Path, option("FILE", "Camera file of `slipid calibrate`.")],
    config: Annotated[
        Path | None,
        option("FILE", "Config of the map: surfaces by colour or points, region, masks."),
    ] = None,
    surfaces: Annotated[
        int | None, option("N", "Number of surfaces to propose.", min=1, max=40)
    ] = None,
    cell: Annotated[
        float | None,
        option(
            "M", "Edge length of a map cell, in m; by default that of a pixel.", min=1e-4, max=1
        ),
    ] = None,
    dictionary: Annotated[
        str, option("NAME", "ArUco dictionary of the robot's marker, to mask the robot.")
    ] = "4X4_50",
    robot_radius: Annotated[
        float, option("M", "Radius of the masked disc around the robot, in m.", min=0, max=10)
    ] = 0.2,
    marker_height: Annotated[
        float, option("M", "Height of the marker above the floor, in m.", kind=Height)
    ] = 0.25,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Make a map of the surfaces of a floor from a picture from above; needs the extra `camera`.

    Without a config, the command proposes surfaces and writes them to palette.toml; rename the
    surfaces there and run the command again with --config. The command writes map.geojson, which
    every option for a floor map accepts, and a picture for checking the map. The exit code is 1 if
    the map is poor.
    """
    from slipid.camera.floor.grid import RobotShape
    from slipid.camera.floor.picture import MapOptions, map_of
    from slipid.camera.overhead import OverheadCamera
    from slipid.support.files import write_bytes
    from slipid.support.jax_setup import one_blas_thread

    one_blas_thread()  # several threads would slow down the many small matrix products
    robot = RobotShape(dictionary, robot_radius, marker_height)
    options = MapOptions(config, surfaces, robot, cell)
    with Reporter(quiet=quiet) as report, locked(out, "map", "map.geojson", "map.png"):
        result = map_of(image, OverheadCamera.load(camera), options, report)
        if result.proposal is not None and (out / PROPOSAL).exists():
            raise DataError(
                f"{out / PROPOSAL}: exists already, and proposing surfaces would overwrite it; "
                f"expected --config {out / PROPOSAL} with surfaces in it, or another folder"
            )
        result.vector.save(out / "map.geojson")
        written = ["map.geojson"]
        if can_draw(report):
            from slipid.plots.floor import floor_plot

            floor_plot(result.vector, result.floor.colour, result.floor.in_view, out / "map.png")
            written.append("map.png")
        if result.proposal is not None:
            write_bytes(out / PROPOSAL, result.proposal.encode())
            written.append(PROPOSAL)
    step = Next(
        "find the floor under each wheel in logged runs",
        ("floors", "out/robot", "--map", out / "map.geojson", "--data", "logs", "--out", "under"),
    )
    if result.proposal is not None:
        step = Next(
            f"after renaming or merging the proposed surfaces in {out / PROPOSAL}",
            ("map", image, "--camera", camera, "--out", out, "--config", out / PROPOSAL),
        )
    emit(json, result.to_json(), lambda page: show(page, result), [step], out, written)
    return 1 if result.poor else 0


def show(page: "Page", result: "PictureMap") -> None:
    """Print the surfaces of a map, and its warnings."""
    from slipid.report.page import table

    content = result.to_json()
    columns = ("surface", "colour", "patches", "area [m^2]", "share", "confidence")
    rows = table(columns, right=columns[2:])
    for one in content["surfaces"]:
        confidence = "" if one["confidence"] is None else f"{one['confidence']:.1f}"
        share, area = f"{100 * one['share']:.1f} %", f"{one['area_m2']:.3f}"
        rows.add_row(one["surface"], one["colour"], str(one["patches"]), area, share, confidence)
    page.table(rows)
    page.line(
        "confidence: how much worse the second best surface explains the least certain patch, in "
        "standard deviations of its colour"
    )
    for robot in result.robots:
        page.line(
            f"robot with marker {robot.marker} masked at x {robot.x:.2f} m, y {robot.y:.2f} m"
        )
    page.notes(content["notes"])
    for sentence in result.warnings:
        page.line(f"warning: {sentence}")
    for sentence in result.poor:
        page.line(f"poor: {sentence}")
