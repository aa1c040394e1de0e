"""What a job keeps beside its results: hashes, versions, the checkpoint of a running fit."""

import hashlib
import platform
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from slipid.data.files import read_json, write_arrays, write_json
from slipid.data.log import DataError


def code(*parts: str) -> bytes:
    """Hash of the sources of some of slipid's packages, by name."""
    root = Path(__file__).resolve().parents[1]
    found = sorted(path for part in parts for path in (root / part).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in found)).digest()


def versions() -> dict[str, str]:
    """Versions of what computes."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version()}
    for name in (
        "slipid",
        "jax",
        "jaxlib",
        "equinox",
        "optimistix",
        "numpy",
        "scipy",
        "emcee",
    ):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def save_checkpoint(path: Path, key: str, state: Any, history: list[float]) -> None:
    """Keep where a fit stands.

    Args:
        key: hash of everything the state depends on; a checkpoint with another one is not used.
        state: of the fit, joint stage.
    """
    write_arrays(
        path,
        {
            "key": np.array(key),
            "z": state.z,
            "log_variance": state.log_variance,
            "round": np.array(state.round),
            "loss": np.array(state.loss),
            "moved": np.array(state.moved),
            "stage": np.array(state.stage),
            "history": np.asarray(history, float),
        },
    )


def save_replicates(path: Path, key: str, rows: list[dict[str, Any]]) -> None:
    """Keep the replicates of a self-test that are done, whatever their number shall be."""
    write_json(path, {"schema": "slipid.replicates/1", "key": key, "rows": rows})


def load_replicates(path: Path, key: str) -> list[dict[str, Any]]:
    """Replicates of this very self-test, none where the file is of another or damaged."""
    try:
        kept = read_json(path, "replicates")
    except DataError:
        return []
    if not isinstance(kept, dict) or kept.get("key") != key:
        return []
    return list(kept["rows"])


def load_checkpoint(path: Path, key: str) -> tuple[Any, list[float]] | None:
    """State and losses so far, or None where there is no checkpoint of this very job."""
    from slipid.identify.problem import State

    try:
        # opened here: numpy leaves a damaged file open
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            state = State(
                z=kept["z"],
                log_variance=kept["log_variance"],
                round=int(kept["round"]),
                loss=float(kept["loss"]),
                moved=float(kept["moved"]),
                stage=str(kept["stage"]),
            )
            return state, [float(x) for x in kept["history"]]
    except (OSError, EOFError, KeyError, ValueError, BadZipFile):
        return None
