"""Sections about the verdict, the numbers to type into a robot, and all values with intervals."""

from collections.abc import Iterator, Sequence

from slipid.fitting.calibration.result import Calibration
from slipid.infer.verdicts.trust import WORDS
from slipid.report.calibration import calibrated_values
from slipid.report.html.blocks import (
    Badge,
    Block,
    Cell,
    CopyLines,
    FigureBlock,
    PageSection,
    TableBlock,
    TextBlock,
    badge,
    enumerated,
    label,
    spanned,
)
from slipid.report.html.figures import axis, dots
from slipid.report.html.results import Results
from slipid.report.numbers import estimate
from slipid.support.content import Content
from slipid.support.errors import first_names

MOST_NOTES = 5
"""Largest number of notes beside the verdict; further ones are in the section on data quality."""
UNDETERMINED = 1.5
"""Width of an interval over that of the prior from which on the interval is not shown [1]."""
USE = {
    WORDS[0]: "Use the selected models on these floors: no simpler model predicts held-out runs "
    "better.",
    WORDS[1]: "Use it with care, and read the reasons first.",
    WORDS[2]: "Do not deploy it as it is. The calibrated lengths below may still be useful.",
}
"""Uses of a result, keyed by the level of trust."""


def verdict(found: Results) -> PageSection:
    """Return the section with the verdict in one line, and what the result may be used for."""
    word = found.trust.get("verdict")
    blocks: list[Block] = []
    if word is None:
        converged = found.fit is not None and found.fit["converged"]
        word = "converged" if converged else "not converged"
        blocks.append(TextBlock([f"The fit has {word}. It has no verdict of trust."]))
    else:
        blocks.append(
            TextBlock([f"{word[0].upper()}{word[1:]}. {USE[word]}"], kind=badge(word).kind)
        )
        if reasons := found.trust["reasons"]:
            blocks.append(TextBlock(reasons, listed=True, kind="warning"))
        blocks.append(_floors(found))
    if found.sample is not None and not found.sample["converged"]:
        more = f"slipid sample {found.folder.name} --most 2000"
        text = (
            f"The posterior has not converged ({found.sample['reason']}), and all intervals are "
            f"from it: continue with `{more}`."
        )
        blocks.append(TextBlock([text], kind="warning"))
    notes = [note for note in ranked_notes(found) if "posterior did not converge" not in note]
    if notes:
        blocks.append(TextBlock(notes[:MOST_NOTES], listed=True, kind="note"))
    return PageSection("verdict", "Verdict", blocks)


def ranked_notes(found: Results) -> list[str]:
    """Return the notes on a result, the most important first."""
    remedies = set() if found.fit is None else {f["remedy"] for f in found.fit["flat"]}
    others = [  # those about directions without information have sections of their own
        m for m in found.identified["messages"] if not any(m.endswith(f": {r}") for r in remedies)
    ]
    return [*found.trust.get("notes", ()), *others]


def _floors(found: Results) -> TableBlock:
    """Return a table of the floors with the selected model and the errors of all models."""
    errors = found.trust["held_out_error_over_path"]
    models = list(dict.fromkeys(model for each in errors.values() for model in each))
    rows: list[Sequence[Cell]] = []
    for floor, each in errors.items():
        shown = (percent(each[model]) if model in each else "" for model in models)
        chosen = label(found.selected[floor])
        rows.append((floor, chosen, *shown, str(found.trust["runs"][floor])))
    caption = (
        "Model selected on each floor, and errors of all models on held-out runs, as a share of "
        "the path length. Of many runs some, evenly chosen, are predicted."
    )
    head = ("floor", "selected model", *map(label, models), "predicted runs")
    return TableBlock(caption, head, rows, right=head[2:])


def percent(value: float) -> str:
    """Return a fraction as text in percent."""
    return f"{100 * value:.2g} %" if value < 0.1 else f"{100 * value:.0f} %"


def numbers(found: Results) -> PageSection | None:
    """Return the section with the numbers to type into a robot."""
    lines = [*_calibrated_lines(found), *_motor_lines(found)]
    if not lines:
        return None
    name = found.run["config"]["name"]
    text = "\n".join([f"# {name}, by slipid {_version(found)}; 90 % intervals", *lines])
    about = TextBlock(
        [
            "Lengths are effective ones: with them, odometry without a slip model is right on "
            "average on that floor. Multipliers are ratios to the lengths of the config, as "
            "drive controllers of ROS take them. Lines that begin with # are remarks, or numbers "
            "that the logs do not determine. Where the force balance is selected, robot.json "
            "predicts better than any lengths: `slipid export` brings it to the robot."
        ]
    )
    blocks: list[Block] = [about, CopyLines("Numbers to type in", text)]
    return PageSection("numbers", "Type these numbers into your robot", blocks)


def _version(found: Results) -> str:
    return str(found.run.get("versions", {}).get("slipid", ""))


def _calibrated_lines(found: Results) -> Iterator[str]:
    """Yield lines about calibrated lengths and the pose sensor, floor by floor."""
    c = found.calibration
    if c is None:
        return
    for floor, one in c["surfaces"].items():
        yield f"\n# floor: {floor}{_error_of_lengths(found, floor)}"
        radii = one["rolling_radius_m"]
        for name, value in zip(
            drive_names(len(radii), bool(c.get("steering"))), radii, strict=False
        ):
            yield _line(f"{name}wheel_radius_m", value)
        for key in ("effective_track_m", "effective_base_m"):
            if key in one:
                name = "wheelbase_m" if c.get("steering") else key
                yield _line(name, one[key])
        if floor in c["centre_of_rotation_m"]:
            centre = c["centre_of_rotation_m"][floor]
            if centre["verdict"] != "fixed":
                yield _line("centre_of_rotation_ahead_m", centre)
        multipliers = c["multipliers"][floor]
        names = drive_names(len(radii), False)
        for name, ratio, value in zip(names, multipliers["wheel_radius"], radii, strict=False):
            yield f"{_hidden(value)}{name}wheel_radius_multiplier: {ratio:.5f}"
        length = "wheel_separation" if len(radii) == 2 else "base"
        base = one.get("effective_track_m") or one["effective_base_m"]
        yield f"{_hidden(base)}{length}_multiplier: {multipliers['track']:.5f}"
    yield "\n# pose sensor"
    ahead, left = c["pose_offset_m"]
    yield _line("pose_sensor_ahead_m", ahead)
    yield _line("pose_sensor_left_m", left)
    yield _line("pose_sensor_yaw_rad", c["pose_yaw_rad"])
    yield _line("pose_lag_s", c["pose_lag_s"])
    for name in ("gyro_scale", "gyro_bias_rad_s"):
        if name in c:
            yield _line(name, c[name])
    for name, value in c.get("steering", {}).items():
        if name != "wheelbase_m":
            yield _line(f"steering_{name}", value)


def _error_of_lengths(found: Results, floor: str) -> str:
    """Return a remark on the error of odometry with calibrated lengths on a floor."""
    errors = found.trust.get("held_out_error_over_path", {}).get(floor, {})
    if "calibrated" not in errors:
        return ""
    text = f" (odometry with these lengths: off by {percent(errors['calibrated'])} of the path"
    chosen = found.selected[floor]
    if chosen == "contact":
        text += f"; selected {label(chosen)}: {percent(errors[chosen])}"
    return f"{text})"


def _hidden(value: Content) -> str:
    """Return the mark of a remark for a number that the logs do not determine."""
    return "# " if value["verdict"] in ("not_identified", "at_bound", "fixed") else ""


def drive_names(count: int, steered: bool) -> list[str]:
    """Return the prefix of the name of each drive."""
    if steered:
        return [""]
    return ["left_", "right_"] if count == 2 else [f"drive_{k + 1}_" for k in range(count)]


MOTOR = {
    "motor.resistance": "motor_resistance_ohm",
    "motor.back_emf": "motor_back_emf_v_s_per_rad",
    "motor.coulomb_friction": "coulomb_friction_at_wheel_n_m",
    "motor.viscous_friction": "viscous_friction_at_wheel_n_m_s_per_rad",
}
"""Name of each number of a motor to type in, keyed by path."""


def _motor_lines(found: Results) -> Iterator[str]:
    """Yield lines about the motor; numbers that the logs do not determine are comments."""
    known = {p: found.parameters[p] for p in MOTOR if p in found.parameters}
    if known:
        yield "\n# motors (winding at the shaft; friction at the wheel, behind the gear)"
    for path, value in known.items():
        yield _line(MOTOR[path], value)


def _line(name: str, value: Content) -> str:
    """Return a line with a number, its interval and, if it is not good, its verdict."""
    ends = value["interval90"]
    shown = estimate(value["value"], ends)
    comments = [spanned(ends)] if ends is not None and value["verdict"] != "fixed" else []
    if value["verdict"] != "identified":
        comments.append(value["verdict"].replace("_", " "))
    text = f"{_hidden(value)}{name}: {shown}"
    return f"{text}  # {'; '.join(comments)}" if comments else text


def values(found: Results) -> PageSection | None:
    """Return the section with all values, intervals and priors, and what to do about weak ones."""
    blocks: list[Block] = []
    if (calibration := found.calibration) is not None:
        blocks.append(calibration_table(calibration))
    rows = list(_rows(found, fixed=False))
    if rows:
        head = ("parameter", "value", "unit", "90 % interval", "prior", "verdict", "meaning")
        caption = (
            f"Parameters of the force balance: {_counts(found)}. Intervals are those of the "
            f"{_origin(found)}. The prior is what was known before the logs, as mean and standard "
            "deviation."
        )
        blocks.append(TableBlock(caption, head, rows, right=("value",)))
        if (figure := _narrowing(found)) is not None:
            blocks.append(figure)
        blocks += _remedies(found)
        fixed = list(_rows(found, fixed=True))
        if fixed:
            caption = "Values that were given or have the default, and were not fitted."
            blocks.append(TableBlock(caption, head, fixed, right=("value",), folded=True))
    if apart := _apart(found):
        blocks += [TextBlock(["Measured twice, with different results:"]), apart]
    return PageSection("values", "Values and intervals", blocks) if blocks else None


def _apart(found: Results) -> TextBlock | None:
    """Return sentences on numbers of the pose sensor on which calibration and fit disagree."""
    c, out = found.calibration, []
    if c is None or found.fit is None:
        return None
    for name, value, path in (
        ("lag of the poses", c["pose_lag_s"], "camera.lag"),
        ("true over logged length", c["pose_scale"], "camera.scale"),
        ("yaw of the pose sensor", c["pose_yaw_rad"], "camera.marker_yaw"),
    ):
        other = found.parameters.get(path)
        if other is None or other["interval90"] is None or value["verdict"] == "fixed":
            continue
        (low, high), (a, b) = value["interval90"], other["interval90"]
        if a > high or b < low:
            mine = f"{estimate(value['value'], (low, high))} {value['unit']}"
            its = estimate(other["value"], (a, b))
            out.append(
                f"{name}: {mine} ({spanned((low, high))}) by the calibrated kinematics, "
                f"{its} ({spanned((a, b))}) by the force balance. Each belongs to its own model: "
                "odometry takes that of the calibration; robot.json has that of the selected model"
            )
    return TextBlock(out, listed=True, kind="warning") if out else None


def _origin(found: Results) -> str:
    """Return where the intervals come from."""
    sources = {e["source"] for e in found.parameters.values()}
    if "posterior" not in sources:
        more = ", and of a short chain where it contradicts this" * ("short_chain" in sources)
        return f"Laplace approximation{more}"
    bad = found.sample is not None and not found.sample["converged"]
    return "posterior, which has NOT converged" if bad else "posterior"


def _counts(found: Results) -> str:
    """Return how many parameters have each verdict."""
    shown = [e for path, e in found.parameters.items() if "session_yaw" not in path]
    words = [e["verdict"] for e in shown if e["verdict"] != "fixed"]
    names = ("identified", "weak", "disputed", "not_identified", "at_bound")
    return enumerated([f"{words.count(w)} {w.replace('_', ' ')}" for w in names if w in words])


def calibration_table(c: Content) -> TableBlock:
    """Return the table of calibrated numbers; `c` is the section of identified.json."""
    rows: list[Sequence[Cell]] = []
    for group, named in calibrated_values(Calibration.of_json(c)).items():
        for name, value in named.items():
            factor, unit = (1000.0, "mm") if value.unit == "m" else (1.0, value.unit)
            ends = [factor * end for end in value.interval90]
            span = "" if value.verdict == "fixed" else spanned(ends)
            shown = estimate(factor * value.value, ends)
            rows.append((f"{group}: {name}", shown, unit, span, badge(value.verdict)))
    head = ("calibrated number", "value", "unit", "90 % interval", "verdict")
    caption = "Calibrated kinematics and pose sensor: what odometry without a slip model needs."
    return TableBlock(caption, head, rows, right=("value",))


def _rows(found: Results, fixed: bool) -> Iterator[Sequence[Cell]]:
    """Yield a row of each parameter, or of each element of a vector."""
    for path, e in found.parameters.items():
        if "session_yaw" in path or (e["verdict"] == "fixed") != fixed:
            continue
        columns = [e.get(n) for n in ("value", "interval90", "prior_mean", "prior_std")]
        count = len(e["labels"])
        if not count:
            columns = [[x] for x in columns]
        each = [x if isinstance(x, list) else [x] * count for x in columns]
        for k, (value, ends, mean, std) in enumerate(zip(*each, strict=True)):
            prior = "" if mean is None or std is None else f"{mean:.3g} ± {std:.2g}"
            wide = (e.get("ratio") or 0.0) > UNDETERMINED
            yield (
                f"{path} [{e['labels'][k]}]" if e["labels"] else path,
                estimate(value, ends),
                e["unit"],
                "wider than the prior" if wide else spanned(ends),
                prior,
                badge(e["verdict"]) if k == 0 else Badge(""),
                e.get("doc", "") if k == 0 else "",
            )


def _narrowing(found: Results) -> FigureBlock | None:
    """Return the figure of how much the logs narrowed each number."""
    shown = {
        p: e["ratio"]
        for p, e in found.parameters.items()
        if e.get("ratio") is not None and "session_yaw" not in p
    }
    if not shown:
        return None
    order = sorted(shown, key=lambda p: shown[p])
    width = [max(min(shown[p], 10.0), 1e-3) for p in order]
    kinds = {
        "good": ("identified", "@blue", "circle"),
        "weak": ("weak or disputed", "@orange", "square"),
        "bad": ("not identified or at bound", "@muted", "x"),
    }
    data = []
    for kind, (name, shade, symbol) in kinds.items():
        mine = [
            k for k, p in enumerate(order) if badge(found.parameters[p]["verdict"]).kind == kind
        ]
        if mine:
            data.append(
                dots(
                    [width[k] for k in mine],
                    [order[k] for k in mine],
                    name,
                    shade,
                    marker={"size": 9, "opacity": 1, "symbol": symbol},
                    hovertemplate="%{y}: %{x:.3g} of the prior's width<extra></extra>",
                )
            )
    good = sum(found.parameters[p]["verdict"] == "identified" for p in order)
    layout = {
        "xaxis": axis(
            "width of the interval over that of the prior",
            type="log",
            tickvals=[0.001, 0.01, 0.1, 1, 10],
            ticktext=["1/1000", "1/100", "1/10", "1", "10"],
        ),
        "yaxis": {
            "automargin": True,
            "categoryorder": "array",
            "categoryarray": order[::-1],
            "tickfont": {"size": 10},
        },
        "showlegend": True,
        "shapes": [
            {
                "type": "line",
                "x0": 1,
                "x1": 1,
                "y0": 0,
                "y1": 1,
                "yref": "paper",
                "line": {"color": "@muted", "dash": "dot"},
            }
        ],
    }
    title = f"The logs determine {good} of {len(order)} parameters"
    alt = f"{title}. Dots show the width of each parameter's interval over that of its prior."
    return FigureBlock(
        "narrowing",
        title,
        alt,
        data,
        layout,
        "Further left: more learnt; at 1 or above: nothing.",
        110 + 17 * len(order),
        minimum=420,
    )


def _remedies(found: Results) -> list[Block]:
    """Return what to do about parameters that the logs do not determine well."""
    if found.fit is None:
        return []
    unknown: dict[tuple[str, str], list[str]] = {}
    for flat in found.fit["flat"]:
        for path in flat["paths"] if flat["remedy"] else ():
            part, _, rest = path.partition(".")
            floor = rest.partition(".")[0] if part == "surface" else ""
            paths = unknown.setdefault((floor, flat["remedy"]), [])
            if path not in paths and "session_yaw" not in path:
                paths.append(path)
    out = []
    for (floor, remedy), paths in sorted(unknown.items()):
        where = f"on {floor}: {remedy.replace('drive there', 'drive')}" if floor else remedy
        if paths:
            out.append(f"{where}: for {enumerated(paths)}")
    verdicts = {p: e["verdict"] for p, e in found.parameters.items() if "session_yaw" not in p}
    # No runs can distinguish a mass ratio from motors in another state.
    weak = [p for p, word in verdicts.items() if word == "weak" and "mass_ratio@" not in p]
    if weak and found.design is None:
        command = f"slipid design {found.folder.name}"
        out.append(
            f"run `{command}`, which proposes the runs that narrow them most: for "
            f"{first_names(weak)}, which are weak"
        )
    elif weak:
        out.append(
            f"drive the runs of 'What to drive next': for {first_names(weak)}, which are weak"
        )
    if not out:
        return []
    return [
        TextBlock(["What to do about numbers that are weak or not identified:"]),
        TextBlock(out, listed=True),
    ]
