"""Reading of the logs that a config names, as one set of runs; also access to packaged files."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from slipid.app.config import BenchMotors, Config, LogsSection, parsed, shape_of
from slipid.data.check.findings import by_reason
from slipid.data.gyro_heading import with_gyro_heading
from slipid.data.log import Log
from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.end_poses import EndPoses, read_end_poses, refuse_unused
from slipid.data.reading.presets import PRESETS, declared_layout, preset
from slipid.data.reading.reader import (
    AnyLayout,
    broken_links,
    find_logs,
    matching,
    read_logs,
    session_of,
    without_beside,
)
from slipid.data.runs import Runs, collect, counted_once
from slipid.infer.result_content import RunContent, checked_result
from slipid.infer.result_folder import CONFIG, RUN, config_text
from slipid.support.checkpoint import versions
from slipid.support.content import Content
from slipid.support.errors import DataError, bad_data, did_you_mean, refused_as
from slipid.support.files import read_json, write_bytes, write_json
from slipid.support.folder import name_of_temporary
from slipid.support.progress import Reporter


def log_folder(out: Path, data: Path | None) -> Path:
    """Return the folder of the logs: the given one, else the folder from which the fit read them.

    Raises:
        DataError: run.json is damaged, or the folder in it no longer exists.
    """
    if data is not None:
        return data
    folder = Path(read_run_file(out).data.folder)
    if not folder.is_dir():
        raise DataError(
            f"{out / RUN}: the folder of the fitted logs, {folder}, is gone; expected --data DIR"
        )
    return folder


def read_run_file(out: Path) -> RunContent:
    """Return what the run.json of a result folder says about config and logs.

    Raises:
        DataError: the file is absent or damaged.
    """
    content = read_json(out / RUN, "the run.json that `slipid identify` writes")
    return checked_result(out / RUN, content, RunContent)


def config_of_fit(out: Path) -> Config:
    """Return the config of the fit in a result folder; raise `DataError` as `config_text` does."""
    return parsed(out / CONFIG, config_text(out))


def read_dataset(
    config: Config,
    sections: Sequence[LogsSection],
    root: Path,
    report: Reporter,
    glob: str | None = None,
) -> tuple[Runs, list[str]]:
    """Return the runs of some log sections, and a line about each log that was left out.

    Args:
        config: the config.
        sections: sections of the config whose logs are read.
        root: data folder.
        report: reporter of the progress.
        glob: pattern of the paths of the files to read instead of all files of the sections.

    Raises:
        DataError: a log cannot be read or is found twice, or there is no run.
    """
    if glob is None:
        found, skipped = required_files(config, sections, root)
    else:
        found, skipped = matching_files(config, sections, root, glob), []
    count = sum(len(paths) for _, paths in found)
    logs: list[Log] = []
    aside: list[str] = []
    sessions: dict[str, str] = {}
    done = short = 0
    for section, paths in found:
        layout = layout_of(config, section)
        surface = None if section.map is not None else section.surface
        table = {} if section.end_poses is None else read_end_poses(root / section.end_poses)
        seen: list[str] = []
        for path in paths:
            inside = read_logs(path, layout, root, surface, section.load)
            aside += inside.aside
            for log in inside.logs:
                if log.samples < section.min_rows:
                    short += 1
                    continue
                seen.append(log.name)
                log = _with_wheels(config, log)
                if section.end_poses is not None:
                    if log.name not in table:
                        aside.append(f"set aside: {log.name}: no row in {section.end_poses}")
                        continue
                    log = _with_ends(config, log, table[log.name])
                elif log.pose is None and log.gyro is not None and log.wheels:
                    log = with_gyro_heading(log)
                if log.name in sessions:
                    raise DataError(
                        f"{log.name}: found by two globs of {config.path}; expected it once"
                    )
                sessions[log.name] = section.session_name or session_of(log, section.session)
                logs.append(log)
            done += 1
            report.advance(done, count)
        if glob is None:
            refuse_unused(table, seen)
    if short:
        skipped.append(f"skipped: {short} runs with fewer rows than the min_rows of their section")
    if not logs:
        nothing = f"{root}: no run in any file of {config.path}; expected logs with a moving robot"
        raise DataError(*(by_reason([*aside, *skipped]) or [nothing]))
    return collect(counted_once(logs), list(sessions.values()), aside), [*skipped, *aside]


def _with_wheels(config: Config, log: Log) -> Log:
    """Return a log without wheels with the wheel angles that roll its travel without slip.

    A calibration of these wheels gives multipliers of the config's lengths, which should be those
    by which the robot computed its odometry. A log without reported travel is returned as it is.
    """
    if log.wheels or log.travel is None:
        return log
    shape = shape_of(config)
    if shape.driven is not None:
        raise DataError(
            f"{log.path}: a twist is logged, but no wheel; expected wheel and steering angles of a "
            "robot that steers"
        )
    angle = log.travel @ np.asarray(shape.forward()).T / float(shape.wheel_radius)
    note = "wheel angles follow from the reported twist and the lengths of the config"
    return replace(log, wheel_angle=angle, travel=None, notes=(*log.notes, note))


def _with_ends(config: Config, log: Log, ends: EndPoses) -> Log:
    """Return a log with the poses at its ends, whose heading must agree with the wheels."""
    shape = shape_of(config)
    if shape.driven is None and shape.drives == log.wheels:
        yaw = np.asarray(shape.pseudo_inverse())[2] * float(shape.wheel_radius)
        ends.check_turn(float((log.wheel_angle[-1] - log.wheel_angle[0]) @ yaw))
    return ends.of(log)


def required_files(
    config: Config, sections: Sequence[LogsSection], root: Path
) -> tuple[list[tuple[LogsSection, list[Path]]], list[str]]:
    """Return the result of `files_of`; raise `DataError` if no section has a file."""
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; expected the folder of the logs (--data)")
    found, skipped = files_of(config, sections, root)
    if not found:
        raise DataError(*(s.removeprefix("skipped: ") for s in skipped))
    return found, skipped


def files_of(
    config: Config, sections: Sequence[LogsSection], root: Path
) -> tuple[list[tuple[LogsSection, list[Path]]], list[str]]:
    """Return the log sections that have files, with their files; also a line about each other."""
    found: list[tuple[LogsSection, list[Path]]] = []
    skipped: list[str] = []
    for section in sections:
        try:
            found.append((section, _files(root, section.glob, f"{config.path}: logs.glob")))
        except DataError as error:
            skipped.append(f"skipped: {error}")
        else:
            if broken := broken_links(root, section.glob):
                skipped.append(f"skipped: {broken}")
    return _of_runs(config, found, root), skipped


def matching_files(
    config: Config, sections: Sequence[LogsSection], root: Path, glob: str
) -> list[tuple[LogsSection, list[Path]]]:
    """Return the files that match a glob, with the log section by which they are read.

    That is the first section whose own glob matches the file. Other files are read by the first
    section if all sections have the same layout, floor and load set-up.

    Raises:
        DataError: no file matches, or the section of a file is not clear.
    """
    rest = _files(root, glob, "--logs")
    if broken := broken_links(root, glob):
        raise DataError(f"--logs '{glob}': {broken}")
    out = []
    for section in sections:
        mine = set(matching(root, section.glob))
        out.append((section, [path for path in rest if path in mine]))
        rest = [path for path in rest if path not in mine]
    if rest:
        if len({(one.format, one.surface, one.load) for one in sections}) > 1:
            raise DataError(
                f"{rest[0]}: matches '{glob}', but no section of {config.path}, and its sections "
                "have different layouts, floors or load set-ups; expected files that match one of "
                + ", ".join(f"'{one.glob}'" for one in sections)
            )
        out.append((sections[0], rest))
    return [(one, paths) for one, paths in _of_runs(config, out, root) if paths]


def _of_runs(
    config: Config, found: Sequence[tuple[LogsSection, list[Path]]], root: Path
) -> list[tuple[LogsSection, list[Path]]]:
    """Return log sections with their files, without additional files and tables of end poses."""
    tables = {root / one.end_poses for one in config.content.logs if one.end_poses is not None}
    return [
        (one, [p for p in without_beside(paths, layout_of(config, one)) if p not in tables])
        for one, paths in found
    ]


def _files(root: Path, glob: str, where: str) -> list[Path]:
    """Return the files that match a glob; `where` names the place of the glob in errors."""
    try:
        return find_logs(root, glob)
    except DataError as error:
        raise DataError(f"{where} '{glob}': {error}") from error


def layout_of(config: Config, section: LogsSection) -> AnyLayout:
    """Return the layout that a log section names: one in the config, else a preset."""
    own = config.content.layouts
    if section.format in own:
        where, declared = f"{config.path} layouts.{section.format}", dict(own[section.format])
        if not isinstance(config.content.robot, BenchMotors):
            declared.setdefault("wheel_radius", config.content.robot.wheel_radius_m)
        kind = declared.get("kind", "rows")
        if kind == "bag":
            return declared_bag_layout(declared, where, config.path.parent)
        if kind != "rows":
            raise DataError(f"{where}.kind: {kind!r}; expected 'rows' (CSV, Parquet) or 'bag'")
        return declared_layout({k: v for k, v in declared.items() if k != "kind"}, where)
    if section.format not in PRESETS:
        names = [*own, *PRESETS]
        hint = did_you_mean(section.format, names)
        raise DataError(
            f"{config.path}: logs.format '{section.format}': no such layout{hint}; "
            f"expected one of {', '.join(names)}"
        )
    return preset(section.format)


def write_run_file(
    out: Path, config: Config, inputs: Content, seconds: float, more: Content
) -> None:
    """Write run.json, which describes how results were made.

    Args:
        out: folder to write to.
        config: the config.
        inputs: content about the logs.
        seconds: duration of the computation [s].
        more: further content.
    """
    content = {
        "schema": "slipid.run/1",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(seconds, 1),
        "config": {"name": config.path.name, "sha256": config.hash},
        "data": inputs,
        **more,
        "versions": versions(),
    }
    write_json(out / RUN, content)


RECORDED = Path(__file__).with_name("recorded.zip")
"""Archive of the recorded logs of the test site that ships with slipid."""
MOST_RECORDED = 64 * 2**20
"""Largest size of these logs [byte]."""


def packaged_path(name: str) -> Path:
    """Return the path of a config, or of something else in its folder, that ships with slipid."""
    package = Path(__file__).parents[1]
    # In a clone of the repository the folder is beside the package, in an installation inside it.
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(f"{name} is missing from this installation of slipid")


def packaged_config(name: str) -> str:
    """Return the text of a config that ships with slipid."""
    return packaged_path(name).read_text(encoding="utf-8")


def unpack(out: Path) -> None:
    """Write the recorded logs of the test site, and their true values, to a folder.

    Raises:
        DataError: the archive is damaged, or the folder has other logs or changed files, which are
            kept.
    """
    expected = "the recorded logs; install slipid again"
    with refused_as(RECORDED, expected), ZipFile(RECORDED) as archive:
        members = archive.infolist()
        if (size := sum(one.file_size for one in members)) > MOST_RECORDED:
            raise bad_data(RECORDED, f"{size} bytes unpacked", f"at most {MOST_RECORDED}")
        content = {one.filename: archive.read(one) for one in members}
    for name in content:
        if ".." in Path(name).parts or not (out / name).is_relative_to(out):
            raise bad_data(RECORDED, f"the path '{name}'", expected)
    _refuse_other_logs(out, content)
    for name, data in content.items():
        write_bytes(out / name, data)


def _refuse_other_logs(folder: Path, content: Mapping[str, bytes]) -> None:
    """Raise `DataError` if a folder has logs that are not among files, or changed files.

    `content` has the files, keyed by their path in the folder. Other line ends are no change.
    """
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: a file; expected a folder of logs (move it away)")
    theirs = [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix == ".csv"
        and name_of_temporary(path.name) is None
        and path.relative_to(folder).as_posix() not in content
    ]
    for path, data in ((folder / name, data) for name, data in content.items()):
        with suppress(OSError):  # not readable: an error when it is written
            theirs += [path] * (_plain(path.read_bytes()) not in (b"", _plain(data)))
    if theirs:
        raise DataError(
            f"{theirs[0]}: no recorded log of this version of slipid, or changed since; expected a "
            "different folder (or move it away)"
        )


def _plain(data: bytes) -> bytes:
    """Return the content of a file with the line ends of Unix, empty if it has only zeros."""
    return data.strip(b"\0").replace(b"\r\n", b"\n")
