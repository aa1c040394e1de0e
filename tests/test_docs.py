"""The documentation: its code runs, its links lead somewhere, its numbers come from files."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from ctypes.util import find_library
from dataclasses import dataclass
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import typer

import slipid
from slipid.cli.main import app
from tests.helpers.kept import kept
from tests.helpers.shared import invoke

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = (
    ROOT / "README.md",
    *(
        page
        for page in sorted(DOCS.rglob("*.md"))
        if not {"_build", "jupyter_execute"} & set(page.relative_to(DOCS).parts)
    ),
)
RESULTS = sorted((DOCS / "results").glob("*.json"))
LANGUAGES = {"sh", "python", "toml", "console", "text"}
"""Languages of code blocks: all but `console` and `text` are run or read by a test."""
ELSEWHERE = {"python.md"}
"""Pages whose blocks other tests run: those of `tests/api`."""


@dataclass(frozen=True)
class Block:
    """A code block of a page: the word after the fence, and its text."""

    page: Path
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.stem}: {self.text.strip().splitlines()[0][:40]}"


def blocks(page: Path, *languages: str) -> list[Block]:
    """Return the code blocks of a page in some languages, by default in all."""
    found = re.findall(r"^( *)```(\S*)[^\n]*\n(.*?)^\1```", page.read_text("utf-8"), re.M | re.S)
    every = (Block(page, language, text) for _, language, text in found)
    return [block for block in every if not languages or block.language in languages]


def all_blocks(*languages: str) -> list[Block]:
    return [block for page in PAGES for block in blocks(page, *languages)]


def lines_of(text: str) -> list[list[str]]:
    """Return the words of each command; comments are left out."""
    joined = text.replace("\\\n", " ")
    words = [shlex.split(line, comments=True) for line in joined.splitlines()]
    return [line for line in words if line and not line[0].startswith("%%")]


def slipid_words(line: list[str]) -> list[str] | None:
    """Return the words after `slipid`; None for another command."""
    return line[1:] if Path(line[0]).name == "slipid" else None


def generate():
    """The module that makes the generated parts of the documentation."""
    spec = importlib.util.spec_from_file_location("docs_generate", DOCS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# --- what is written ---


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_code_block_has_a_language(page):
    own = {block.language for block in blocks(page)}
    assert {name for name in own if not name.startswith("{")} <= LANGUAGES


@pytest.mark.parametrize("block", all_blocks("toml"), ids=str)
def test_toml_is_read(block):
    assert tomllib.loads(block.text)


COMMANDS = [
    block
    for block in all_blocks("sh", "console", "{code-cell}")
    if block.language != "{code-cell}" or block.text.startswith("%%sh")
]


@pytest.mark.parametrize("block", COMMANDS, ids=str)
def test_commands_and_options_exist(block):
    known = typer.main.get_command(app).commands
    for line in lines_of(block.text):
        words = slipid_words(line)
        if words is None or not words:
            continue
        options = {name for p in known[words[0]].params for name in p.opts}
        used = {word.partition("=")[0] for word in words[1:] if word.startswith("--")}
        assert used <= options | {"--help"}, words[0]


def test_all_public_names_are_in_the_reference():
    listed = [name for names in generate().GROUPS.values() for name in names]
    assert len(listed) == len(set(listed))
    assert set(listed) == set(slipid.__all__) - {"made_runs", "move"}  # older names


def test_every_command_is_in_the_reference():
    text = generate().commands()
    for name, command in typer.main.get_command(app).commands.items():
        assert f"`slipid {name}`" in text
        shown = [p for p in command.params if not p.hidden and p.name != "help"]
        assert all(p.opts[0] in text for p in shown if p.param_type_name == "option")


@cache
def strings_of_the_package() -> str:
    """All texts in the package, one a line, cut where an f-string has braces."""
    paths = sorted((ROOT / "slipid").rglob("*.py"))
    nodes = (node for path in paths for node in ast.walk(ast.parse(path.read_text("utf-8"))))
    constants = (node.value for node in nodes if isinstance(node, ast.Constant))
    return "\n".join(value for value in constants if isinstance(value, str))


def messages() -> list[str]:
    page = (DOCS / "howto" / "errors.md").read_text(encoding="utf-8")
    return re.findall(r"^\| (`+.*?`+) \| ", page, re.M)


def test_there_are_messages():
    assert len(messages()) > 35


@pytest.mark.parametrize("message", messages())
def test_a_catalogued_message_is_one_of_the_program(message):
    parts = [part for part in message.strip("`").split("...") if part.strip(" ;:,'")]
    assert parts
    for part in parts:
        assert part in strings_of_the_package()


# --- numbers ---


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_a_results_file_is_complete(path):
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["schema"] == "slipid.results/1"
    for key in ("title", "values", "command", "machine", "slipid"):
        assert content[key], key
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", content["date"])
    assert content["rows"]
    assert {len(row) for row in content["rows"]} == {len(content["columns"])}
    assert all(0 <= k < len(content["rows"]) for k in content["bold_rows"])


def test_the_results_page_types_no_number():
    text = (DOCS / "results.md").read_text(encoding="utf-8")
    assert {f"{path.stem}" for path in RESULTS} == set(
        re.findall(r"^```\{generated\} result (\w+)$", text, re.M)
    )
    prose = re.sub(r"^```.*?^```$|`[^`\n]*`", "", text, flags=re.M | re.S)
    assert "|" not in prose
    prose = prose.replace("github.com/BrOleg5/", "")
    assert set(re.findall(r"\d+", prose)) <= {"2021"}  # the paper


def test_results_become_tables():
    text = generate().expand("```{generated} result left_out_sectors\n```")
    assert "| **force balance (slipid)** | **1.3** | **1.5** |" in text
    assert "bench_left_out.py -k sectors" in text
    assert generate().text([2.9, 2.7, 3.1]) == "2.9 [2.7, 3.1]"
    assert generate().text(None) == ""


# --- README ---


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_the_table_of_the_readme_is_that_of_the_results():
    content = json.loads((DOCS / "results" / "left_out_sectors.json").read_text(encoding="utf-8"))
    made = [[str(cell) for cell in row] for row in (content["columns"], *content["rows"])]
    text = (ROOT / "README.md").read_text(encoding="utf-8").replace("**", "")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    begin = next(k for k, row in enumerate(rows) if row[0] == "percent")
    shown = rows[begin : begin + 11]
    assert len(shown) == 11
    assert [row for row in made if row in shown] == shown


def test_links_of_the_readme_lead_to_files():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert target.startswith("http") or (ROOT / target).exists(), target


# --- code that runs ---


def run_page(page: Path, folder: Path, monkeypatch, *languages: str) -> tuple[dict, list[str]]:
    """Run the blocks of a page in a folder, in their order.

    Return the names that they leave, and the output of commands that fail.
    """
    monkeypatch.chdir(folder)
    names: dict = {}
    failed: list[str] = []
    for block in blocks(page, *languages):
        if block.language == "python":
            exec(compile(block.text, str(page), "exec"), names)
            continue
        for line in lines_of(block.text):
            status, output = run_line(line, folder)
            if status:
                failed.append(f"{line}\n{output}")
    return names, failed


def run_line(line: list[str], folder: Path) -> tuple[int, str]:
    """Return the exit status and the output of a command; `make` only shows what it would do."""
    words = slipid_words(line)
    if words is not None:
        done = invoke(*words)
        return done.exit_code, done.output
    if line[0] == "make":
        line, folder = ["make", "-n", *line[1:]], ROOT
    made = subprocess.run(line, cwd=folder, check=False, capture_output=True, text=True)
    return made.returncode, made.stdout + made.stderr


@pytest.fixture
def demo_folder(small, tmp_path) -> Path:
    """A folder in which `make demo` seems to have run: a small fit lies where its result would."""
    shutil.copytree(small[0] / "out", tmp_path / "demo_out" / "result")
    return tmp_path


RUN = [
    page
    for page in PAGES
    if page.name not in {"README.md", *ELSEWHERE} and blocks(page, "python", "sh")
]


LONG = {"what_to_drive", "deploy"}
"""Pages whose commands take more than ten seconds."""
QUICK = [page for page in RUN if page.stem not in LONG]


@pytest.mark.slow
@pytest.mark.parametrize("page", kept(RUN, QUICK), ids=lambda page: page.stem)
def test_code_of_a_page_runs(page, demo_folder, monkeypatch):
    _, failed = run_page(page, demo_folder, monkeypatch, "python", "sh")
    assert not failed


@pytest.mark.slow
def test_the_python_of_the_readme_runs_after_the_demo(demo_folder, monkeypatch):
    names, _ = run_page(ROOT / "README.md", demo_folder, monkeypatch, "python")
    assert len(names["estimate"].pose) == 3
    assert (demo_folder / "robot.json").is_file()
    (text,) = (block.text for block in blocks(ROOT / "README.md", "python"))
    assert len([line for line in text.splitlines() if line.strip()]) <= 12


@pytest.mark.nightly
def test_the_commands_of_the_readme_run(tmp_path, monkeypatch):
    """On the logs that the first tutorial makes."""
    monkeypatch.chdir(tmp_path)
    cell = blocks(DOCS / "tutorials" / "differential.md", "{code-cell}")[0].text
    exec(compile(cell, "differential.md", "exec"), {})
    _, failed = run_page(ROOT / "README.md", tmp_path, monkeypatch, "sh")
    assert not failed
    assert (tmp_path / "to_go" / "ros2" / "drive_controller.yaml").is_file()


# --- the site ---


class Links(HTMLParser):
    """Targets of links and pictures in a page, and the names that it has itself."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: set[str] = set()
        self.names: set[str] = set()
        self.pictures: list[dict] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        given = dict(attrs)
        self.names |= {given[key] for key in ("id", "name") if given.get(key)}
        self.targets |= {given[key] for key in ("href", "src") if given.get(key)}
        if tag == "img":
            self.pictures.append(given)


def built(out: Path, execute: str) -> str:
    """Build the site into a folder, warnings being errors; return what was printed."""
    pytest.importorskip("sphinx")
    words = ["-b", "html", "-W", "--keep-going", "-q", "-d", out / "doctrees", DOCS, out / "html"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *map(str, words)],
        env=os.environ | {"SLIPID_DOCS_EXECUTE": execute, "PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def broken_links(site: Path) -> list[str]:
    """Return the local links of a built site that lead nowhere."""
    pages = {path: Links(path.read_text("utf-8")) for path in sorted(site.rglob("*.html"))}
    broken = []
    for path, page in pages.items():
        for target in page.targets:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            end = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            name = unquote(parts.fragment)
            fine = end.exists() and (not name or end not in pages or name in pages[end].names)
            if not fine:
                broken.append(f"{path.relative_to(site)}: {target}")
    return broken


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    """Without running its notebooks, which `make docs` and the nightly tests do."""
    built(tmp_path, "off")
    assert broken_links(tmp_path / "html") == []


@pytest.mark.nightly
def test_the_site_builds_with_its_notebooks(tmp_path):
    built(tmp_path, "force")
    site = tmp_path / "html"
    assert broken_links(site) == []
    filmed = ("omni_camera",) if find_library("EGL") else ()
    for name in ("differential", "motor", *filmed):  # a calibration alone draws no picture
        page = Links((site / "tutorials" / f"{name}.html").read_text("utf-8"))
        shown = [picture for picture in page.pictures if "_images" in picture["src"]]
        assert shown
        assert all(picture.get("alt") for picture in shown)
