"""Models of motion of a fit or of a calibration, which predict its runs."""

from collections.abc import Mapping
from dataclasses import dataclass

from slipid.fitting.calibration.result import Calibration
from slipid.infer.result import Fit
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot
from slipid.predict.kinematics import nominal
from slipid.predict.predictive import ForceBalance
from slipid.predict.selection import calibrated_model
from slipid.predict.slip_models import FloorModels


@dataclass(frozen=True, eq=False)
class MotionModels:
    """Models of motion of a fit or of a calibration.

    Attributes:
        kinematic: the models `nominal` and `calibrated`, as far as there are; keyed by name.
        seen: robot with the pose sensor by which they are judged.
        shape: geometry with the lengths of the config.
        contact: the fitted force balance; None in a calibration alone.
        calibration: calibration with the noise of kinematic models; None in a fit without it.
        selected: name of the selected model, keyed by floor.
        currents: True if currents were fitted, so that they tell the floor.
    """

    kinematic: Mapping[str, FloorModels]
    seen: Robot
    shape: Geometry
    contact: ForceBalance | None
    calibration: Calibration | None
    selected: Mapping[str, str]
    currents: bool

    @classmethod
    def of_fit(cls, fit: Fit) -> "MotionModels":
        """Return the models of a fit; on floors without a selection, it is the force balance."""
        selected = dict.fromkeys(fit.robot.surfaces.labels, "contact")
        selected |= {floor: one.model for floor, one in fit.selection.items()}
        shape, has_current = fit.config_shape, fit.channels.current
        kinematic = _kinematic(shape, fit.calibration)
        return cls(kinematic, fit.seen, shape, fit.contact, fit.calibration, selected, has_current)

    @classmethod
    def of_calibration(
        cls, found: Calibration, selected: Mapping[str, str], shape: Geometry, seen: Robot
    ) -> "MotionModels":
        """Return the models of a calibration without a force balance.

        Args:
            found: the calibration.
            selected: name of the selected model, keyed by floor.
            shape: geometry with the lengths of the config.
            seen: robot with the calibrated pose sensor.
        """
        return cls(_kinematic(shape, found), seen, shape, None, found, selected, False)

    def sensor(self, floor: str) -> Robot:
        """Return the robot with the pose sensor by which the selected model is judged."""
        if self.contact is None or self.selected.get(floor) in self.kinematic:
            return self.seen
        return self.contact.robot


def _kinematic(shape: Geometry, calibration: Calibration | None) -> dict[str, FloorModels]:
    """Return the kinematic models: the lengths of the config, and the calibrated ones, if any."""
    models = {"nominal": FloorModels(nominal(shape))}
    if calibration is not None:
        models["calibrated"] = calibrated_model(calibration, shape)
    return models
