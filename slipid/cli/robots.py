"""`slipid robots`: list the reference robots, or show the numbers of one."""

from typing import Annotated

import typer

from slipid.cli.common import Json, Next, emit, guarded


@guarded
def robots(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Robot to show; all by default.")
    ] = None,
    json: Json = None,
) -> int:
    """List well-known robots identified from public logs, or show the numbers of one."""
    from slipid.app.reference_robots import reference_robot, reference_robots
    from slipid.report.reference_robots import show_robot, show_robots

    if name is not None:
        one = reference_robot(name)
        step = Next("a config that starts from its numbers", ("new", "--robot", name))
        emit(json, one.to_json(), lambda page: show_robot(page, one), [step])
        return 0
    every = reference_robots()
    content = {"schema": "slipid.references/1", "robots": [one.to_json() for one in every]}
    following = [
        Next("all numbers of one", ("robots", every[0].name)),
        Next("a config that starts from its numbers", ("new", "--robot", every[0].name)),
    ]
    emit(json, content, lambda page: show_robots(page, every), following)
    return 0
