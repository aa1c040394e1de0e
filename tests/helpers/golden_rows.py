"""Results as rows of plain numbers and words, for comparison with the reviewed tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

CURVE_POINTS = (10, 25, 40)
"""Places on a slip curve that are compared."""


def listed(value: Any) -> list[float]:
    """A number or a short vector as a list."""
    return np.atleast_1d(np.asarray(value, float)).tolist()


def of_identified(content: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Every number of identified.json that was fitted: one row per entry."""
    for part in ("parameters", "derived"):
        for path, e in content[part].items():
            if e["verdict"] == "fixed":
                continue
            intervals = e["interval90"] if e["labels"] else [e["interval90"]]
            each = zip(listed(e["value"]), listed(e["std"]), intervals, strict=True)
            for k, (value, std, (low, high)) in enumerate(each):
                yield {
                    "path": path if not e["labels"] else f"{path}[{k + 1}]",
                    "value": value,
                    "std": std,
                    "low": low,
                    "high": high,
                    "verdict": f"{e['verdict']}, {e['provenance']}, {e['source']}",
                }


def of_curves(content: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Some points of every slip curve."""
    for floor, curve in content["curves"].items():
        for k in CURVE_POINTS:
            yield {
                "floor": floor,
                "torque_nm": curve["torque_nm"][k],
                "slip": curve["slip"][k],
                "low": curve["slip_lo"][k],
                "high": curve["slip_hi"][k],
            }


def of_variances(std: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """Std of every noise component."""
    for name, value in std.items():
        yield {"component": name, "std": value}


def of_validation(content: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The summary of a validation file: a row per floor and model."""
    for floor, models in content["summary"].items():
        for model, row in models.items():
            numbers = {k: float("nan") if v is None else float(v) for k, v in row.items()}
            yield {"floor": floor, "model": model, **numbers}
