"""What is wrong with the logs of a job or with its config, before anything is fitted."""

from collections.abc import Iterator, Sequence

from slipid.data.reading.reader import AnyLayout
from slipid.data.sanity.finding import Finding, worst_first, wrong
from slipid.data.sanity.sanity import findings
from slipid.job.logs import layout_of
from slipid.job.problem import Job, Task
from slipid.support.errors import DataError

_AT_MOTOR = ("wheel_ticks", "motor_angle", "motor_speed", "motor_speed_command")
"""Channels that the gear ratio of a layout turns into motion of the wheel."""


def sanity(task: Task) -> tuple[Finding, ...]:
    """Findings about the runs of a task, and about the config where there is one; worst first."""
    mass = task.config.content.wheels.mass_kg if isinstance(task, Job) else None
    said = [*_braking(task), *findings(task.dataset, task.robot.geometry, mass)]
    if isinstance(task, Job):
        said += [*_forgotten(task), *_two_gears(task)]
    return worst_first(said)


def refuse_if_wrong(found: Sequence[Finding]) -> None:
    """DataError with all that is wrong, if anything is."""
    if bad := wrong(found):
        listed = "\n".join(f"  {k}. {finding}" for k, finding in enumerate(bad, start=1))
        raise DataError(
            f"not fitted: logs and config do not go together\n{listed}\n"
            "expected them put right, or --anyway to fit all the same"
        )


def _braking(task: Task) -> Iterator[Finding]:
    """Magnitudes of currents beside voltages, of wheels that drag each other along in turns.

    On made runs of a skid-steer robot R then was off by ten of its stds, and called identified.
    """
    runs = task.dataset
    has = runs.current is not None and runs.voltage is not None
    if has and not runs.current_is_signed and not task.robot.geometry.determines_twist:
        yield Finding(
            "braking_unseen",
            "currents are magnitudes, and in turns a wheel that is dragged along brakes: read with "
            "the voltages as if it drove, they give a wrong resistance and back-EMF",
            "log currents with their sign, or take the voltage out of the layout",
            "wrong",
        )


def _forgotten(job: Job) -> Iterator[Finding]:
    """Numbers of the robot that torques scale with, and that were left at their defaults."""
    logged = [n for n in ("current", "voltage") if getattr(job.dataset, n) is not None]
    robot = job.config.content.wheels
    absent = ["mass_kg"] if robot.mass_kg is None else []
    absent += [] if "gear_ratio" in robot.model_fields_set else ["gear_ratio"]
    if not logged or not absent:
        return
    taken = {"mass_kg": f"{float(job.robot.body.mass):g} kg", "gear_ratio": "1"}
    yield Finding(
        "forgotten",
        f"{' and '.join(f'{n} ({taken[n]} would be taken)' for n in absent)} left out of [robot], "
        f"though a {' and a '.join(logged)} is logged: motor and friction scale with them",
        "write " + " and ".join(f"{n} = ..." for n in absent) + " into [robot]",
        "wrong",
    )


def _two_gears(job: Job) -> Iterator[Finding]:
    """Gear ratios of the robot and of a layout that differ."""
    robot = job.config.content.wheels
    if "gear_ratio" not in robot.model_fields_set:
        return
    seen: set[str] = set()
    for section in job.config.content.logs:
        layout = layout_of(job.config, section)
        if section.format in seen or not _uses_gear(layout):
            continue
        seen.add(section.format)
        if abs(layout.gear_ratio / robot.gear_ratio - 1) > 1e-3:
            yield Finding(
                "two_gear_ratios",
                f"gear_ratio is {robot.gear_ratio:g} in [robot] and {layout.gear_ratio:g} in the "
                f"layout '{section.format}' of the logs",
                "write the same number into both, or name the columns as those of the wheel "
                "(wheel_angle, wheel_speed), if they are of the wheel",
                "wrong",
            )


def _uses_gear(layout: AnyLayout) -> bool:
    return any(channel in layout.holds for channel in _AT_MOTOR)
