"""Result folder of `slipid identify`: its files are those of one fit.

Every file that depends on a fit repeats the fit's checksum under the key `fit`, and commands that
read several files compare them with `fit_of`. Before a fit is replaced, the files that depend on it
are deleted, see `files_of_fit`; thus what a killed command leaves is incomplete, but never mixed.
"""

from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from slipid.infer.result_content import RunContent, checked_result
from slipid.support.errors import DataError
from slipid.support.files import read_json
from slipid.support.toml_file import text_of

FIT, IDENTIFIED, RUN, CONFIG, ROBOT = (
    *("fit.json", "identified.json", "run.json", "config.toml", "robot.json"),
)
OF_FIT = (
    *(ROBOT, "evidence.json", "report.html"),
    *("slip_by_heading.png", "slip_by_torque.png", "paths.png", "current_by_traction.png"),
    *("load_share.png", "profile.json", "profile.png", "bench.png"),
    *("motor_feedforward.h", "motor_feedforward.yaml"),
    *("sample.json", "posterior.nc", "posterior_intervals.png", "posterior_pairs.png"),
    *("validation.json", "validation_errors.png", "validation_paths.png"),
    *("design.json", "design.png", "design_commands.csv", "trial.json", "trial.png"),
    IDENTIFIED,
)
"""Names of the files in a result folder that depend on a fit, besides fit.json and its arrays,
run.json and the copy of the config.

They are deleted in this order. The last one shows that the folder has a result."""
WRITTEN = (FIT, RUN, *OF_FIT)
"""Names of the files that `slipid identify` and later commands write to a result folder."""
_AGAIN = "run `slipid identify` again"


def files_of_fit(folder: Path, new: str = "", keep_config: bool = False) -> list[Path]:
    """Return the paths of the files that depend on the fit in a folder, present or not.

    A folder without a fit has none: a robot.json in it is not slipid's to delete.

    Args:
        folder: the result folder.
        new: checksum of the fit that is about to be written; there is nothing to delete if the
            folder already has it.
        keep_config: True if the copy of the config is not among the files, since it is written
            anew; it may be the only copy, and is never absent then.
    """
    if not any((folder / name).exists() for name in (FIT, IDENTIFIED)):
        return []
    with suppress(DataError):  # a damaged fit is replaced like any other
        if new and fit_of(folder) == new:
            return []
    return [folder / name for name in ((RUN,) if keep_config else (RUN, CONFIG)) + OF_FIT]


def fit_of(folder: Path) -> str | None:
    """Return the checksum of the fit in a folder, None if there is none or its files lack it.

    For a calibration alone it is the checksum in identified.json. A run.json of an older version
    has none, and is not compared.

    Raises:
        DataError: files in the folder are of different fits, the copy of the config was changed, or
            the writing of a fit was interrupted; the message says what to do.
    """
    marks = {FIT: _under(folder / FIT, "checksum")}
    marks |= {name: _under(folder / name, "fit") for name in (IDENTIFIED, RUN)}
    if marks[FIT] is not None and (folder / IDENTIFIED).exists():
        marks[IDENTIFIED] = marks[IDENTIFIED] or "none"
    known = {name: mark for name, mark in marks.items() if mark is not None}
    first = next(iter(known), None)
    for name, mark in known.items():
        if mark != known[first or name]:
            raise DataError(
                f"{folder / name}: belongs to a different fit than {first} in this folder; "
                f"expected both from the same fit ({_AGAIN})"
            )
    if known and (folder / CONFIG).exists() and not (folder / RUN).exists():
        raise DataError(
            f"{folder / RUN}: missing, since the writing of a fit was interrupted; {_AGAIN}"
        )
    if known and (folder / CONFIG).exists():
        config_text(folder)  # refused if it was changed
    return None if first is None else str(known[first])


def refuse_other_fit(folder: Path, path: Path, fit: object) -> None:
    """Raise `DataError` if a file has the checksum of a fit, and it is not the one in the folder.

    Args:
        folder: the result folder.
        path: the file.
        fit: checksum in the file; None for a file of an older version, which has none.
    """
    if fit is not None and fit != fit_of(folder):
        raise DataError(f"{path}: of a different fit than the one in {folder}; {_AGAIN}")


def config_text(folder: Path) -> str:
    """Return the text of the config in a result folder.

    Raises:
        DataError: the config or run.json is absent, or the config was changed since the fit.
    """
    path = folder / CONFIG
    text = text_of(path)
    if not _is_text(text, _hash_of_config(folder)):
        raise DataError(
            f"{path}: not the config of the fit, whose SHA-256 is in {RUN}; expected this file "
            "unchanged, since results depend on it. To use a changed config, copy it and run "
            "`slipid identify` with it"
        )
    return text


def refuse_foreign_config(folder: Path, text: str, path: Path | None = None) -> None:
    """Raise `DataError` if there is a config that would be overwritten and that no fit has used.

    Args:
        folder: the result folder.
        text: text of the config to be written.
        path: the file to write, by default the copy of the config in the folder.
    """
    path = path or folder / CONFIG
    if not path.is_file() or _is_text(found := text_of(path), _hash(text)):
        return
    try:
        copied = _is_text(found, _hash_of_config(folder))
    except DataError:  # damaged, of an older version, or the writing of a fit was interrupted
        copied = any((folder / name).exists() for name in (FIT, IDENTIFIED))
    if not copied:
        raise DataError(
            f"{path}: no copy that slipid made for a fit, or changed since, and would be "
            "overwritten; expected a different folder (or move the file away)"
        )


def _is_text(text: str, mark: str) -> bool:
    """Return whether a text has this SHA-256, with the line ends of any system.

    Version control and editors change them, and the one at the end, without being asked.
    """
    plain = text.replace("\r\n", "\n")
    forms = (plain, plain.removesuffix("\n"), plain + "\n")
    return mark in {_hash(f) for one in forms for f in (text, one, one.replace("\n", "\r\n"))}


def _hash(text: str) -> str:
    return sha256(text.encode()).hexdigest()


def _hash_of_config(folder: Path) -> str:
    """Return the SHA-256 of the config of a fit, as in run.json."""
    content = read_json(folder / RUN, "the run.json that `slipid identify` writes")
    return checked_result(folder / RUN, content, RunContent).config.sha256


def _under(path: Path, key: str) -> object:
    """Return what a JSON file has under a key, None if either is absent."""
    if not path.exists():
        return None
    found = read_json(path, "the result of `slipid identify`")
    return found.get(key) if isinstance(found, dict) else None
