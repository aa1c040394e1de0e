"""Identify a wheeled robot's motors, load shares and wheel-floor contact from its logs.

Every name below is loaded at its first use: importing slipid loads and changes nothing.
"""

from importlib import import_module

# type checkers treat this name as True; importing it from `typing` would load that module
TYPE_CHECKING = False
if TYPE_CHECKING:
    from slipid.api.calibration import calibrate as calibrate
    from slipid.api.camera import track as track
    from slipid.api.fit import Prior as Prior
    from slipid.api.fit import fit as fit
    from slipid.api.robot import drive as drive
    from slipid.api.robot import export as export
    from slipid.api.runs import check as check
    from slipid.api.runs import simulate_runs as simulate_runs
    from slipid.api.runs import steady_motion as steady_motion
    from slipid.app.reference_robots import reference_robot as reference_robot
    from slipid.app.reference_robots import reference_robots as reference_robots
    from slipid.camera.overhead import OverheadCamera as OverheadCamera
    from slipid.camera.tracking.tracking import LoneMarker as LoneMarker
    from slipid.data.reading.presets import layout as layout
    from slipid.data.reading.reader import read_runs as read_runs
    from slipid.deploy.floors import FloorLookup as FloorLookup
    from slipid.deploy.floors import floor_map as floor_map
    from slipid.infer.posterior.blocks import Plan as Plan
    from slipid.infer.posterior.diagnosis import Posterior as Posterior
    from slipid.infer.result import Fit as Fit
    from slipid.infer.verdicts.profile import Profile as Profile
    from slipid.model.robot import Robot as Robot
    from slipid.plots.fit import plot_runs as plot_runs
    from slipid.plots.wheels import wheel_curve as wheel_curve
    from slipid.predict.validation import Validation as Validation
    from slipid.robot.controller import Controller as Controller
    from slipid.robot.deployed import DeployedRobot as DeployedRobot
    from slipid.robot.estimator import Estimator as Estimator
    from slipid.robot.interface import Measurement as Measurement
    from slipid.support.errors import DataError as DataError
    from slipid.support.jax_setup import setup_jax as setup_jax

    made_runs, move = simulate_runs, steady_motion

__version__ = "0.2.0"
_ROOMS = {
    "Controller": "slipid.robot.controller",
    "DataError": "slipid.support.errors",
    "DeployedRobot": "slipid.robot.deployed",
    "Estimator": "slipid.robot.estimator",
    "Fit": "slipid.infer.result",
    "FloorLookup": "slipid.deploy.floors",
    "LoneMarker": "slipid.camera.tracking.tracking",
    "Measurement": "slipid.robot.interface",
    "OverheadCamera": "slipid.camera.overhead",
    "Plan": "slipid.infer.posterior.blocks",
    "Posterior": "slipid.infer.posterior.diagnosis",
    "Prior": "slipid.api.fit",
    "Profile": "slipid.infer.verdicts.profile",
    "Robot": "slipid.model.robot",
    "Validation": "slipid.predict.validation",
    "calibrate": "slipid.api.calibration",
    "check": "slipid.api.runs",
    "drive": "slipid.api.robot",
    "export": "slipid.api.robot",
    "fit": "slipid.api.fit",
    "floor_map": "slipid.deploy.floors",
    "layout": "slipid.data.reading.presets",
    "plot_runs": "slipid.plots.fit",
    "read_runs": "slipid.data.reading.reader",
    "reference_robot": "slipid.app.reference_robots",
    "reference_robots": "slipid.app.reference_robots",
    "setup_jax": "slipid.support.jax_setup",
    "simulate_runs": "slipid.api.runs",
    "steady_motion": "slipid.api.runs",
    "track": "slipid.api.camera",
    "wheel_curve": "slipid.plots.wheels",
}
_ALIASES = {"made_runs": "simulate_runs", "move": "steady_motion"}
"""Older public names, which keep working, and the names that replace them."""
__all__ = sorted([*_ROOMS, *_ALIASES])


def __getattr__(name: str) -> object:
    """Return a public name from the module that defines it (PEP 562)."""
    name = _ALIASES.get(name, name)
    if name not in _ROOMS:
        raise AttributeError(f"module 'slipid' has no attribute '{name}'")
    return getattr(import_module(_ROOMS[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
