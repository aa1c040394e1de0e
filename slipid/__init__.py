"""Identify a wheeled robot's motors, load shares and wheel-floor contact from its own logs.

Everything below is loaded when it is first asked for: importing slipid loads and changes nothing.
"""

from importlib import import_module

TYPE_CHECKING = False  # known to type checkers by its name, without loading `typing`
if TYPE_CHECKING:
    from slipid.api.camera import track as track
    from slipid.api.check import check as check
    from slipid.api.driving import drive as drive
    from slipid.api.export import export as export
    from slipid.api.fit import Prior as Prior
    from slipid.api.fit import fit as fit
    from slipid.api.known_robot import made_runs as made_runs
    from slipid.api.known_robot import move as move
    from slipid.control.controller import Controller as Controller
    from slipid.control.deployed import DeployedRobot as DeployedRobot
    from slipid.control.estimator import Estimator as Estimator
    from slipid.control.interface import Measurement as Measurement
    from slipid.data.reading.presets import layout as layout
    from slipid.data.reading.reader import read_runs as read_runs
    from slipid.deploy.floors import FloorLookup as FloorLookup
    from slipid.deploy.floors import floor_map as floor_map
    from slipid.identify.compare.validation import Validation as Validation
    from slipid.identify.posterior.blocks import Plan as Plan
    from slipid.identify.posterior.diagnosis import Posterior as Posterior
    from slipid.identify.result import Fit as Fit
    from slipid.identify.verdicts.profile import Profile as Profile
    from slipid.model.robot import Robot as Robot
    from slipid.plots.raw import plot_runs as plot_runs
    from slipid.plots.wheels import wheel_curve as wheel_curve
    from slipid.support.errors import DataError as DataError
    from slipid.support.jax_setup import setup_jax as setup_jax
    from slipid.vision.camera import OverheadCamera as OverheadCamera
    from slipid.vision.tracking.tracking import LoneMarker as LoneMarker

__version__ = "0.1.0"
_ROOMS = {
    "Controller": "slipid.control.controller",
    "DataError": "slipid.support.errors",
    "DeployedRobot": "slipid.control.deployed",
    "Estimator": "slipid.control.estimator",
    "Fit": "slipid.identify.result",
    "FloorLookup": "slipid.deploy.floors",
    "LoneMarker": "slipid.vision.tracking.tracking",
    "Measurement": "slipid.control.interface",
    "OverheadCamera": "slipid.vision.camera",
    "Plan": "slipid.identify.posterior.blocks",
    "Posterior": "slipid.identify.posterior.diagnosis",
    "Prior": "slipid.api.fit",
    "Profile": "slipid.identify.verdicts.profile",
    "Robot": "slipid.model.robot",
    "Validation": "slipid.identify.compare.validation",
    "check": "slipid.api.check",
    "drive": "slipid.api.driving",
    "export": "slipid.api.export",
    "fit": "slipid.api.fit",
    "floor_map": "slipid.deploy.floors",
    "layout": "slipid.data.reading.presets",
    "made_runs": "slipid.api.known_robot",
    "move": "slipid.api.known_robot",
    "plot_runs": "slipid.plots.raw",
    "read_runs": "slipid.data.reading.reader",
    "setup_jax": "slipid.support.jax_setup",
    "track": "slipid.api.camera",
    "wheel_curve": "slipid.plots.wheels",
}
__all__ = sorted(_ROOMS)


def __getattr__(name: str) -> object:
    """A public name from the room it lives in (PEP 562)."""
    if name not in _ROOMS:
        raise AttributeError(f"module 'slipid' has no attribute '{name}'")
    return getattr(import_module(_ROOMS[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
