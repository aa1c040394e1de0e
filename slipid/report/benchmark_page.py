"""The benchmark as one page of HTML, with its pictures inside."""

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from pathlib import Path

from slipid.report.benchmark import (
    COSTS,
    absent,
    cells,
    costs,
    headings,
    others,
    picked,
    ranked,
    shown,
)
from slipid.support.content import Content
from slipid.support.files import write_bytes

PAGE = "benchmark.html"
LEGEND = (
    "End point: distance between the predicted and the true end, over the chord or the path. "
    "Minus slipid's: the difference on the same runs, below zero where the row is better. "
    "Length: of the chord or the path. Heading: at the end. "
    "Twist: root mean square in windows of half a second. "
    "In 90 %: how many ends lie in the row's own 90 % region. "
    "Slip AUC: area under the receiver operating characteristic of slip detection. "
    "Floor: part of the time in which the right floor is named, or rightly none. "
    "Energy: error of the electric energy of a run. "
    "Numbers: how many are fitted. Fit, step: time to fit once, and to predict one step of a run."
)
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 92rem; margin: 2rem auto }
body { padding: 0 1rem }
h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc } h3 { margin-bottom: .3rem }
.wide { overflow-x: auto } img { max-width: 100% }
table { border-collapse: collapse; font-size: 13px; white-space: nowrap }
th, td { text-align: right; padding: .15rem .6rem; border-bottom: 1px solid #eee }
th:first-child, td:first-child { text-align: left; font-family: monospace }
tr.own { background: #fdeee3; font-weight: 600 } .note { color: #666; font-size: 13px }
"""


def write_page(found: Content, pictures: Mapping[str, bytes], out: Path) -> Path:
    """Write the page of a benchmark's content below a folder; arguments as of `page`."""
    path = out / PAGE
    write_bytes(path, page(found, pictures).encode())
    return path


def page(found: Content, pictures: Mapping[str, bytes]) -> str:
    """The whole page: what it says, then a picture and the tables of every data set.

    Args:
        found: content of benchmark.json.
        pictures: PNG files by the name of the data set they show.
    """
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>Slip methods compared</title><style>{STYLE}</style>",
        "<h1>Slip methods compared</h1>",
        "<p>Every row was fitted to the same runs and predicts others, from what the robot itself "
        "measures; the pose is used once, at the start. Numbers in brackets are 90&nbsp;% "
        "intervals by resampling runs; settings were picked on training runs alone.</p>",
        f"<p class='note'>{escape(LEGEND)}</p>",
        "<h2>What the tables say</h2><ul>",
        *(f"<li>{escape(sentence)}</li>" for sentence in found["reading"]),
        "</ul>",
    ]
    for name, one in found["sets"].items():
        parts += _set(found, name, one, pictures.get(name))
    for name, other in others(found):
        parts.append(f"<h2>{escape(name.replace('_', ' '))}</h2>")
        parts.append(f"<p>{escape(other.said or other.title)}</p>")
        if not other.said:
            parts.append(html_table(other.head, other.body))
    parts.append(f"<p class='note'>{_versions(found)}</p></html>")
    return "\n".join(parts)


def _set(found: Content, name: str, one: Content, drawn: bytes | None) -> list[str]:
    parts = [f"<h2>{escape(name)}</h2><p>{escape(one['about'])}; {one['runs']} runs</p>"]
    if drawn is not None:
        parts.append(picture(drawn, f"End-point errors on {name}"))
    for protocol, rows in one["protocols"].items():
        title = f"{protocol.replace('_', ' ')}: {found['protocols'][protocol]}"
        parts.append(f"<h3>{escape(title)}</h3>")
        numbers = shown(rows)
        head = ("row", *headings(numbers), *COSTS)
        body = [(row, *cells(content, numbers), *costs(content)) for row, content in ranked(rows)]
        parts.append(html_table(head, body))
        parts += [f"<p class='note'>{escape(line)}</p>" for line in absent(rows)]
        if lines := picked(rows):
            parts.append("<details class='note'><summary>settings picked, fold by fold</summary>")
            parts += [*(f"<div>{escape(line)}</div>" for line in lines), "</details>"]
    return parts


def html_table(head: tuple[str, ...], body: list[tuple[str, ...]]) -> str:
    """A table whose first column names the row; slipid's own rows stand out."""
    lines = [
        "<div class='wide'><table><tr>",
        *(f"<th>{escape(cell)}</th>" for cell in head),
        "</tr>",
    ]
    for row in body:
        own = " class='own'" if row[0].startswith(("slipid", "contact")) else ""
        lines.append(f"<tr{own}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return "".join([*lines, "</table></div>"])


def picture(png: bytes, said: str) -> str:
    """A picture inside the page, with what it shows in words."""
    data = b64encode(png).decode()
    return f"<img alt='{escape(said)}' src='data:image/png;base64,{data}'>"


def _versions(found: Content) -> str:
    said = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    return escape(f"{said}; this call took {found['seconds']:.0f} s")
