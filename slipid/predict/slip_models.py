"""The slip models below the force balance that a fit is compared with, and back from files."""

from collections.abc import Mapping, Sequence

import numpy as np

from slipid.model.geometry import Geometry
from slipid.predict.curves import Curve, Saturating, above, powers, ramps, soft_torque
from slipid.predict.floor_models import FloorModels
from slipid.predict.kinematics import TERMS, Corrected, Encoder, HeadingLookup, Together, nominal
from slipid.predict.steps import TwistModel

KNOTS = (0.0, 0.02, 0.04, 0.06, 0.1, 0.15, 0.25)
"""Of the monotone spline [N m]."""
PAPER_THRESHOLD = 0.4
"""Current above which the 2021 paper's deployed form corrects [A]."""


def slip_models(
    shape: Geometry, has_current: bool, together: Together | None = None
) -> list[FloorModels]:
    """Every slip model the logs allow, unfitted; `paper` is the form the authors ran on the robot.

    The shape is the robot's as its config has it: wheels that do not determine the twist have
    models of their own. The threshold of `paper` and the spline's knots are for motors of that
    size. Runs that will be left out `together` are so, too, where a model tunes itself.
    """
    models: list[TwistModel] = [nominal(shape), Encoder()]
    if shape.determines_twist:
        models += _of_wheels(has_current, together)
    else:
        models += [Corrected(name, shape) for name in TERMS]
    return [FloorModels(model) for model in models]


def _of_wheels(has_current: bool, together: Together | None) -> list[TwistModel]:
    """Slip wheel by wheel, and by the direction of travel."""
    out: list[TwistModel] = [Curve("constant", powers(0))]
    if has_current:
        out += [
            Curve("linear", powers(1), soft_torque),
            Curve("affine", powers(0, 1), soft_torque),
            Curve("svr", powers(0, 1), soft_torque, insensitive=True),
            Curve("quadratic", powers(0, 1, 2), soft_torque),
            Saturating(),
            Curve("monotone_spline", ramps(KNOTS), soft_torque, monotone=True),
            Curve("affine_current", powers(0, 1)),
            Curve("paper", above(PAPER_THRESHOLD), per_wheel=True),
        ]
    return [*out, HeadingLookup(ridge=None, together=together)]


def restored(shape: Geometry, states: Mapping[str, Mapping[str, Sequence]]) -> list[FloorModels]:
    """Slip models from their names and states, as `{model.name: model.state}` wrote them."""
    known = {model.name: model for model in slip_models(shape, has_current=True)}
    if strange := sorted(set(states) - set(known)):
        raise ValueError(f"no model '{strange[0]}'; there are: {', '.join(known)}")
    return [
        known[name].with_state({floor: np.asarray(v, float) for floor, v in state.items()})
        for name, state in states.items()
    ]
