"""Belyaev, Brylev, Ivanov 2021, regenerated: its tables, figures, stored models, and its method.

Source: "Slip Detection and Compensation System for Mobile Robot in Heterogeneous Environment",
IFAC-PapersOnLine 54(13), 2021; data of its authors' repository BrOleg5/Slippage-compensation.
"""

from slipid.baselines.paper2021.models import (
    CURRENT_SVR,
    DEPLOYED,
    TORQUE_SVR,
    DeployedModel,
    fit_deployed,
    polynomial,
    smooth_current,
)
from slipid.baselines.paper2021.result import PaperResult, find_folder, regenerate
from slipid.baselines.paper2021.samples import FIGURE_2, FIGURES_3_AND_4, Recipe, Samples
from slipid.baselines.paper2021.table import FittedForm, MotorTable, field_table, surface_tables
from slipid.baselines.paper2021.tracks import TRACK_FILES, Track, read_tracks
from slipid.baselines.paper2021.transfer import Transfer, leave_one_surface_out
from slipid.baselines.paper2021.windows import WindowRecipe, refit_deployed, wheel_windows

__all__ = [
    "CURRENT_SVR",
    "DEPLOYED",
    "FIGURES_3_AND_4",
    "FIGURE_2",
    "TORQUE_SVR",
    "TRACK_FILES",
    "DeployedModel",
    "FittedForm",
    "MotorTable",
    "PaperResult",
    "Recipe",
    "Samples",
    "Track",
    "Transfer",
    "WindowRecipe",
    "field_table",
    "find_folder",
    "fit_deployed",
    "leave_one_surface_out",
    "polynomial",
    "read_tracks",
    "refit_deployed",
    "regenerate",
    "smooth_current",
    "surface_tables",
    "wheel_windows",
]
