"""Files of a fit: fit.json, its arrays in an npz file named by their hash, and identified.json.

identified.json is a table for people and other programs. One checksum covers the whole fit. The
renaming of a new fit.json over the old one replaces an old fit in one step: if the process ends
before that, the folder still holds the old fit, otherwise the new one. What depends on the old fit
is deleted just before, see `slipid.infer.result_folder`.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from slipid.fitting.calibration.result import Calibration
from slipid.fitting.shared_effects import FittedEffects, SpeedAndLoad
from slipid.infer.held_out import HeldOut
from slipid.infer.result import Channels, Fit
from slipid.infer.result_content import AGAIN, FitContent, checked_result
from slipid.infer.result_folder import CONFIG, FIT, IDENTIFIED, files_of_fit, fit_of
from slipid.infer.slip_curves import SlipCurve
from slipid.infer.verdicts.draws import Draws
from slipid.infer.verdicts.estimates import Estimate
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot, Validity, build
from slipid.parameter import entries
from slipid.predict.selection import FloorSelection
from slipid.search_space import Choice, Space, with_values
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import checksum, json_text, read_bytes, read_json, write_together
from slipid.support.parsing import MOST_ARRAY_BYTES, arrays_of

_RESULT = "the result of `slipid identify`"
SCHEMA, SCHEMA_FIT = "slipid.identified/1", "slipid.fit/9"
_PLAIN = ("converged", "reason", "rounds", "remaining")
_CURVE = ("torque_nm", "slip", "slip_lo", "slip_hi")
_LARGEST = 1e18
"""Largest magnitude in the covariance of the search vector, and in its inverse."""
_SHARED = ("std", "coefs", "by_number", "covariance")
_MIXED = ("mixed", "refused")
_SHAPE = ("place", "drive_angle", "roller_angle", "grips", "drive_of", "gear_ratio")


def save(fit: Fit, folder: Path, config: str | None = None) -> tuple[str, ...]:
    """Write a fit to a folder, and return the names of the files.

    A different fit in the folder is replaced, and all files that depend on it are deleted. If the
    folder has the same fit, they stay.

    Args:
        fit: the fit.
        folder: folder to write to.
        config: text of the config, which is written together with the fit, or None.

    Raises:
        ValueError: a value is not finite; in this case nothing is written.
        DataError: the folder cannot be written to.
    """
    arrays = _packed(fit)
    sha256 = hashlib.sha256(arrays).hexdigest()
    name = f"fit-{sha256[:12]}.npz"
    content = to_json(fit) | {"arrays": {"file": name, "sha256": sha256}}
    content = json.loads(json_text(content))
    content |= {"checksum": checksum(content)}
    table = json_text(identified_json(fit) | {"fit": content["checksum"]})
    files = {name: arrays, FIT: json_text(content).encode(), IDENTIFIED: table.encode()}
    if config is not None:
        files[CONFIG] = config.encode()
    write_together(
        {folder / k: data for k, data in files.items()},
        files_of_fit(folder, content["checksum"], keep_config=config is not None),
    )
    for old in folder.glob("fit-????????????.npz"):
        if old.name != name:
            old.unlink()
    return IDENTIFIED, FIT, name


def load(folder: Path) -> Fit:
    """Return the fit that `save` wrote to a folder.

    Raises:
        DataError: a file is absent, damaged, of another version or of another fit.
    """
    path = folder / FIT
    content = read_json(path, _RESULT)
    found = content.get("schema") if isinstance(content, dict) else None
    if found != SCHEMA_FIT:
        what = f"its schema is {found}" if isinstance(found, str) else "it has no schema"
        raise DataError(f"{path}: {what}; expected {SCHEMA_FIT}, {_RESULT} of this version")
    if content.pop("checksum", None) != checksum(content):
        raise DataError(f"{path}: damaged or edited, its checksum differs; expected {_RESULT}")
    checked_result(path, content, FitContent)
    arrays = _unpacked(folder, **content["arrays"])
    try:
        fit = from_json(content, arrays)
        _check(fit)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {AGAIN}") from error
    fit_of(folder)
    return fit


def _packed(fit: Fit) -> bytes:
    buffer = io.BytesIO()
    arrays = {"covariance": fit.covariance, "laplace": fit.laplace}
    if fit.chain is not None:
        arrays |= {"chain": fit.chain.z}
    for floor, found in fit.shared.items():
        arrays |= {f"shared/{floor}/{name}": getattr(found, name) for name in _SHARED}
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _unpacked(folder: Path, file: str, sha256: str) -> dict[str, np.ndarray]:
    """Return the arrays of a fit, after a check of the file's hash."""
    path = folder / file
    packed = read_bytes(path, f"the arrays of {FIT}", MOST_ARRAY_BYTES)
    if hashlib.sha256(packed).hexdigest() != sha256:
        raise DataError(f"{path}: damaged, its hash differs from the one in {FIT}; {AGAIN}")
    try:
        return arrays_of(packed)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {AGAIN}") from error


def identified_json(fit: Fit) -> Content:
    """Return the content of identified.json."""
    return {
        "schema": SCHEMA,
        "parameters": {path: number_json(e) for path, e in fit.parameters.items()},
        "derived": {path: number_json(e) for path, e in fit.derived.items()},
        "surfaces": list(fit.robot.surfaces.labels),
        "curves": curves_json(fit.curves),
        "validity": {floor: asdict(v) for floor, v in fit.validity.items()},
        **_held_out_json(fit),
        "load_comparisons": [c.to_json() for c in fit.load_comparisons],
        "messages": list(fit.messages),
        **_selected_json(fit),
        "data": {"hash": fit.data_hash, "runs": [name for name, _ in fit.runs]},
    }


def _held_out_json(fit: Fit) -> Content:
    """Return the errors of motor currents in held-out windows, if voltages were logged."""
    return {} if fit.held_out is None else {"held_out": fit.held_out.to_json()}


def _selected_json(fit: Fit) -> Content:
    """Return the parts of identified.json about calibration, selected models and trust."""
    if fit.calibration is None:
        return {}
    return {
        "calibration": fit.calibration.to_json(),
        "selected_model": {floor: one.model for floor, one in fit.selection.items()},
        "trust": fit.trust.to_json(),
    }


def number_json(e: Estimate) -> Content:
    """Return an estimate in the form of identified.json."""
    shape = [len(e.labels)] if e.labels else []
    known = {k: getattr(e, k) for k in ("std", "interval90", "source", "verdict", "provenance")}
    return {"value": e.value, "unit": e.unit, "shape": shape, "labels": list(e.labels)} | known


def curves_json(curves: Mapping[str, SlipCurve]) -> Content:
    """Return slip curves, keyed by floor, as plain values."""
    return {
        floor: {name: getattr(c, name).tolist() for name in _CURVE}
        | {"at": {"wheel_speed": c.wheel_speed, "load_share": c.load_share}}
        for floor, c in curves.items()
    }


def to_json(fit: Fit) -> Content:
    """Return the content of fit.json: the fit without its large arrays, but with its messages."""
    return {
        "schema": SCHEMA_FIT,
        **{name: getattr(fit, name) for name in _PLAIN},
        "history": [x if np.isfinite(x) else None for x in fit.history],
        "parameters": {p: asdict(e) for p, e in fit.parameters.items()},
        "derived": {p: asdict(e) for p, e in fit.derived.items()},
        "flat": [asdict(f) | {"text": f.text} for f in fit.flat],
        "load_comparisons": [c.to_json() for c in fit.load_comparisons],
        "messages": list(fit.messages),
        "variances": {
            name: {"variance": v, "std": float(np.sqrt(v)), "unit": fit.variance_unit[name]}
            for name, v in fit.variance.items()
        },
        "names": fit.space.names,
        "z": fit.z.tolist(),
        "robot": _robot_json(fit.space.template),
        "choices": [asdict(c) for c in fit.choices],
        "has": {name: getattr(fit.channels, name) for name in ("current", "voltage", "gyro")},
        "curves": curves_json(fit.curves),
        "validity": {floor: asdict(v) for floor, v in fit.validity.items()},
        "settings": {
            "lag": fit.lag,
            "windows_per_piece": fit.channels.windows,
            "current_is_signed": fit.channels.signed,
            "seed": fit.seed,
        }
        | ({} if fit.mixed is None else {"mixed": dict(fit.mixed)})
        | ({} if fit.refused is None else {"refused": dict(fit.refused)}),
        "current_trend": list(fit.current_trend),
        **_held_out_json(fit),
        "shared": {
            floor: [asdict(p) for p in found.speeds_and_loads]
            for floor, found in fit.shared.items()
        },
        "extrapolation": dict(fit.extrapolation),
        "baselines": dict(fit.baselines),
        "calibration": None if fit.calibration is None else fit.calibration.to_json(),
        "selection": {floor: one.to_json() for floor, one in fit.selection.items()},
        "suspects": list(fit.suspects),
        "robot_settings": {path: list(pair) for path, pair in fit.robot_settings.items()},
        "data": {"hash": fit.data_hash, "runs": [list(r) for r in fit.runs]},
    }


def from_json(content: Content, arrays: Mapping[str, np.ndarray]) -> Fit:
    """Return the fit from the content of fit.json and its arrays."""
    choices = tuple(Choice(**c) for c in content["choices"])
    space = Space(_robot_of(content["robot"]), choices)
    if space.names != content["names"]:
        raise ValueError("its parameters differ from those that this version declares")
    n = space.size
    for at, found in (("z", content["z"]), *_near(content["settings"])):
        if len(found) != n:
            raise ValueError(f"{at}: {len(found)} numbers; expected {n}, one per name")
    variances, settings = content["variances"], content["settings"]
    return Fit(
        space=space,
        choices=choices,
        z=np.asarray(content["z"], float),
        variance={name: v["variance"] for name, v in variances.items()},
        variance_unit={name: v["unit"] for name, v in variances.items()},
        runs=tuple((str(name), str(sha)) for name, sha in content["data"]["runs"]),
        channels=Channels(
            **content["has"],
            signed=settings["current_is_signed"],
            windows=settings["windows_per_piece"],
        ),
        curves={
            floor: SlipCurve(**{k: np.asarray(c[k], float) for k in _CURVE} | c["at"])
            for floor, c in content["curves"].items()
        },
        validity={floor: Validity(**_tuples(v)) for floor, v in content["validity"].items()},
        history=tuple(np.inf if x is None else x for x in content["history"]),
        lag=settings["lag"],
        seed=settings["seed"],
        mixed=settings.get("mixed"),
        refused=settings.get("refused"),
        extrapolation=content["extrapolation"],
        baselines=content["baselines"],
        calibration=content["calibration"] and Calibration.of_json(content["calibration"]),
        selection={f: FloorSelection.of_json(x) for f, x in content["selection"].items()},
        suspects=tuple(content["suspects"]),
        robot_settings={
            path: (value, origin)
            for path, (value, origin) in content.get("robot_settings", {}).items()
        },
        current_trend=(content["current_trend"][0], content["current_trend"][1]),
        held_out=content.get("held_out") and HeldOut.of_json(content["held_out"]),
        shared={
            floor: _effects(arrays, floor, paces, n) for floor, paces in content["shared"].items()
        },
        covariance=_array(arrays, "covariance", n, n),
        laplace=_array(arrays, "laplace", n, n),
        chain=Draws(_array(arrays, "chain", None, None, n)) if "chain" in arrays else None,
        **{name: content[name] for name in _PLAIN},
    )


def _near(settings: Content) -> list[tuple[str, list[float]]]:
    """Return the search vectors, with their names, at which runs over several floors were cut."""
    return [(f"settings.{k}.near", x["near"]) for k, x in settings.items() if k in _MIXED and x]


def _array(arrays: Mapping[str, np.ndarray], name: str, *shape: int | None) -> np.ndarray:
    """Return an array of numbers, of a shape in which None stands for any length.

    Raises:
        ValueError: the array is absent, not finite or of another shape.
    """
    found = arrays.get(name, np.array("nothing"))
    if found.dtype != float or not np.isfinite(found).all():
        raise ValueError(f"array {name}: expected finite numbers")
    same = found.ndim == len(shape) and all(
        b in (None, a) for a, b in zip(found.shape, shape, strict=True)
    )
    if not same:
        raise ValueError(f"array {name} of shape {found.shape}; expected {shape}")
    return found


def _effects(
    arrays: Mapping[str, np.ndarray], floor: str, paces: list[Content], n: int
) -> FittedEffects:
    """Return the shared effects on a floor of a fit with `n` free coordinates."""
    of_floor = f"shared/{floor}"
    q = _array(arrays, f"{of_floor}/coefs", 3, None).shape[1]
    shapes = {"std": (3,), "coefs": (3, q), "by_number": (3, q, n), "covariance": (3, q, 3, q)}
    parts = {name: _array(arrays, f"{of_floor}/{name}", *shape) for name, shape in shapes.items()}
    return FittedEffects(tuple(SpeedAndLoad(**pace) for pace in paces), **parts)


def _check_covariance(found: np.ndarray) -> None:
    """Raise `ValueError` for a matrix that is no covariance, or that verdicts cannot invert."""
    if np.diag(found).min(initial=0) < 0:
        raise ValueError("negative variances; expected a covariance")
    np.linalg.cholesky(found)  # whose LinAlgError is a ValueError
    inverse = np.linalg.inv(found)
    large = max(np.abs(found).max(initial=0), np.abs(inverse).max(initial=0))
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    if (np.abs(found - found.T) > 1e-6 * scale).any() or not large < _LARGEST:
        raise ValueError("not symmetric, or singular; expected a covariance")


def _check(fit: Fit) -> None:
    """Raise `ValueError` if parts of a fit contradict each other, or a value is not finite."""
    for found in (fit.covariance, fit.laplace):
        _check_covariance(found)
    if fit.chain is not None and not fit.chain.z.size:
        raise ValueError("a chain without draws")
    with np.errstate(over="ignore"):
        for e in entries(fit.robot):
            if not np.isfinite(np.asarray(e.get(fit.robot))).all():
                raise ValueError(f"{e.path} = {e.get(fit.robot)}; expected finite numbers")
    floors = {*fit.curves, *fit.validity, *fit.shared, *fit.selection}
    floors |= {*fit.calibration.radius} if fit.calibration is not None else {*()}
    if other := sorted(floors - {*fit.robot.surfaces.labels}):
        raise ValueError(f"the floor '{other[0]}', which the robot does not know")
    for floor, chosen in fit.selection.items():
        if chosen.model not in chosen.errors or chosen.model not in {*fit.baselines, "contact"}:
            raise ValueError(f"selection.{floor}: no errors or numbers of {chosen.model}")


def _tuples(plain: Content) -> Content:
    """Return the content with nested lists of JSON replaced by tuples."""

    def deep(x: Any) -> Any:
        return tuple(map(deep, x)) if isinstance(x, list) else x

    return {name: deep(x) for name, x in plain.items()}


def _robot_json(robot: Robot) -> Content:
    """Return a robot as plain values: geometry, floors, loads, sessions and all parameters."""
    return {
        "geometry": {name: getattr(robot.geometry, name) for name in _SHAPE},
        "surfaces": list(robot.surfaces.labels),
        "loads": list(robot.body.loads),
        "sessions": list(robot.camera.sessions),
        "centre": list(robot.camera.centre),
        "values": {e.path: np.asarray(e.get(robot)).tolist() for e in entries(robot)},
    }


def _robot_of(kept: Content) -> Robot:
    shape = _tuples(kept["geometry"])
    wheels, drives = len(shape["place"]), len(set(shape["drive_of"]))
    geometry = Geometry(
        drive_offset=jnp.zeros(wheels), radius_deviation=jnp.zeros(drives or wheels), **shape
    )
    names = kept["surfaces"], kept["loads"], kept["sessions"]
    robot = build(geometry, *names, centre=tuple(kept["centre"]))
    known = {e: kept["values"].get(e.path) for e in entries(robot)}
    for e, value in known.items():
        if value is None or np.size(value) != e.size:
            raise ValueError(f"robot.values: {e.path}: {value}; expected {e.size} numbers")
    restored: Robot = with_values(robot, known)
    return restored
