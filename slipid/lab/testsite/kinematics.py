"""Effective kinematics of a robot on ordinary wheels, measured from its true motion."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from slipid.lab.testsite.driving import SiteRun, TimedTwists
from slipid.lab.testsite.robot_build import RobotBuild
from slipid.support.content import Content

ROWS = 50
"""Number of rows of the true motion, a hundredth of a second apart, in one span."""
ROUNDS = 6
"""Number of times that radii and track are computed in turn."""
Motion = tuple[SiteRun, Float[np.ndarray, "_step 3"], Float[np.ndarray, "_step drive"]]
"""A run, its true poses [m, m, rad] and the true angles of its wheels [rad]."""


def effective_kinematics(robot: RobotBuild, motions: Iterable[Motion]) -> Content:
    """Return the effective kinematics by load set-up and surface, as in truth/kinematics.json.

    Only open-loop runs on a single surface count. Every value is a least-squares ratio over all
    spans of half a second of one kind of run. The rolling radius of each drive is the path of its
    side over the wheel's angle in straight runs. The effective track is the difference of the
    paths that the two sides roll at these radii over the turn. The centre of rotation, positive
    ahead of the middle, is the motion to the right over the turn. `arcs` are all runs with turns
    that do not only turn on the spot. Without straight runs, the radii are those of the wheels;
    without turns, `arcs` or `on_the_spot` are missing.
    """
    spans: dict[tuple[str, str], dict[str, list[np.ndarray]]] = {}
    for run, pose, angle in motions:
        if run.surface is not None and isinstance(run.program, TimedTwists):
            kinds = spans.setdefault((run.load, run.surface), {})
            steps = np.concatenate([_body_steps(pose), np.diff(angle, axis=0)], axis=1)
            kinds.setdefault(_kind(run.program), []).append(
                np.add.reduceat(steps, np.arange(0, len(steps), ROWS))
            )
    found: dict[str, dict[str, Content]] = {}
    for (load, surface), kinds in spans.items():
        found.setdefault(load, {})[surface] = _of_surface(
            robot, {kind: np.concatenate(rows) for kind, rows in kinds.items()}
        )
    return found


def _of_surface(
    robot: RobotBuild, kinds: Mapping[str, Float[np.ndarray, "_span motion"]]
) -> Content:
    """Return the effective kinematics on one surface, from the motions over spans of each kind.

    Radii and track depend on each other, since no run is quite straight; they are computed in turn.
    """
    sides = np.sign(robot.places[: robot.drives, 1])
    radii, track = robot.radii[: robot.drives], float(np.ptp(robot.places[:, 1]))
    turning: dict[str, dict[str, float]] = {}
    for _ in range(ROUNDS):
        if "straight" in kinds:
            motion, angle = kinds["straight"][:, :3], kinds["straight"][:, 3:]
            path = motion[:, :1] - 0.5 * track * sides * motion[:, 2:]
            radii = (path * angle).sum(axis=0) / (angle**2).sum(axis=0)
        for kind in ("on_the_spot", "arcs"):
            if kind in kinds:
                left, turn, rims = kinds[kind][:, 1], kinds[kind][:, 2], kinds[kind][:, 3:] * radii
                difference = rims[:, sides < 0].mean(axis=1) - rims[:, sides > 0].mean(axis=1)
                track = float(difference @ turn / (turn @ turn))
                turning[kind] = {
                    "effective_track_m": track,
                    "centre_of_rotation_m": float(-left @ turn / (turn @ turn)),
                }
    return {"rolling_radius_m": radii.tolist(), **turning}


def _kind(program: TimedTwists) -> str:
    """Return `straight`, `on_the_spot` or `arcs`."""
    twists = [twist for twist, _ in program.legs]
    if not any(turn for *_, turn in twists):
        return "straight"
    return "arcs" if any(ahead for ahead, *_ in twists) else "on_the_spot"


def _body_steps(pose: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, "increment 3"]:
    """Return the displacements ahead and to the left, and the turns, between successive poses."""
    step = np.diff(pose, axis=0)
    middle = pose[:-1, 2] + 0.5 * step[:, 2]
    c, s = np.cos(middle), np.sin(middle)
    ahead, left = c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0]
    return np.stack([ahead, left, step[:, 2]], axis=1)
