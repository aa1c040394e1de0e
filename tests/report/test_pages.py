"""Pages of results, in a real browser."""

import json
import re
import shutil
from itertools import pairwise

import pytest

from slipid.report.html.evidence import MapEvidence, read_evidence, write_evidence
from slipid.report.html.fit_page import write_report
from slipid.report.html.page import REPORT
from slipid.report.numbers import estimate
from slipid.support.errors import DataError
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.robots import ROBOTS
from tests.helpers import made_bench
from tests.helpers.browser import WIDTHS, Shown, chromium
from tests.helpers.shared import invoke

pytestmark = pytest.mark.slow
MOST_BYTES = 8_000_000
CALIBRATED = {
    "differential": "diff_right",
    "mecanum": "mecanum_wrong_base",
    "no_heading": next(r.name for r in ROBOTS if r.pose_kind == "xy"),
    "heading_alone": next(r.name for r in ROBOTS if r.pose_kind == "heading"),
    "steered": "ackermann_understeer",
}
"""Made robot of every page of a calibration."""


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def fitted(small, tmp_path_factory):
    """A copy of a result folder with everything that a robot with a fit may have."""
    folder, _ = small
    out = tmp_path_factory.mktemp("fitted") / "out"
    shutil.copytree(folder / "out", out)
    return out


def page_of(small, tmp_path, kind):
    """The page of a kind of result."""
    if kind == "motor":
        log = tmp_path / "motor.csv"
        made_bench.write(made_bench.logged(made_bench.driven(made_bench.FLYWHEEL), 200, 1), log)
        words = ("motor", log, "--out", tmp_path / "out", "--quiet")
    elif kind == "check":
        folder, _ = small
        config = folder / "my.toml"
        words = ("check", config, "--data", folder / "logs", "--out", tmp_path / "out", "--quiet")
    else:
        robot = next(r for r in ROBOTS if r.name == CALIBRATED.get(kind, "diff_right"))
        write(robot, tmp_path, 0)
        if kind == "one_run":
            for path in sorted((tmp_path / "logs").rglob("*.csv"))[1:]:
                path.unlink()
        where = ("--data", tmp_path / "logs", "--out", tmp_path / "out", "--quiet")
        words = ("identify", tmp_path / "robot.toml", *where, "--only", "calibration")
    result = invoke(*words)
    assert isinstance(result.exception, SystemExit | None), result.output
    return tmp_path / "out" / REPORT


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_of_a_fit_is_drawn_without_an_error_and_without_network(browser, fitted, width):
    path = write_report(fitted)
    assert path.stat().st_size < MOST_BYTES
    shown = Shown(browser, path, width, "dark" if width < 1000 else "light")
    assert shown.draw_all() >= 8
    assert (shown.errors, shown.requests) == ([], [])
    assert shown.overflow <= 0


def test_runs_can_be_chosen_and_played_and_numbers_copied(browser, fitted):
    shown = Shown(browser, write_report(fitted), 1440)
    page = shown.page
    shown.draw_all()
    runs = read_evidence(fitted / "evidence.json").runs
    options = page.locator(".run option")
    assert options.count() == len(runs)
    page.locator(".next").click()
    state = page.locator(".state").inner_text()
    assert f"{runs[1].path_m:.2f} m" in state
    page.locator(".time").fill("0")
    assert re.search(r"After 0\.0 s off by: .* 0 mm", page.locator(".state").inner_text())
    page.locator(".play").click()
    page.wait_for_function(
        "document.querySelector('.state').textContent.includes('After 0.0') === false"
    )
    page.locator(".play").click()  # pauses
    page.locator("#numbers .copy").click()
    page.wait_for_function("document.querySelector('#numbers .copy').textContent === 'Copied'")
    copied = page.evaluate("navigator.clipboard.readText()")
    found = json.loads((fitted / "identified.json").read_text())["parameters"]["motor.resistance"]
    assert f"motor_resistance_ohm: {estimate(found['value'], found['interval90'])}" in copied
    assert copied == page.locator("#numbers pre").inner_text()
    page.locator("select[data-of=residuals]").select_option("yaw rate [deg/s]")
    drawn = "document.querySelector('[data-figure=residuals]').layout.yaxis.title.text"
    assert page.evaluate(drawn) == "yaw rate [deg/s]"
    assert shown.errors == []


def test_runs_over_several_floors_are_drawn_on_their_map(browser, fitted, tmp_path):
    shutil.copytree(fitted, tmp_path / "out")
    found = read_evidence(tmp_path / "out/evidence.json")
    cells = [[0, 0, 1, 1]] * 4
    floor = MapEvidence(surfaces=["soft", "rug"], corner_m=(-1, -1), cell_m=(0.5, 0.5), cells=cells)
    over = [found.runs[0].model_copy(update={"map": 0, "region": None})]
    found = found.model_copy(update={"over_floors": over, "maps": [floor]})
    write_evidence(found, tmp_path / "out")
    shown = Shown(browser, write_report(tmp_path / "out"), 360, "dark")
    shown.draw_all()
    page = shown.page
    page.locator(".run").select_option(str(len(found.runs)))
    assert page.locator(".run optgroup").last.get_attribute("label") == "several floors"
    drawn = page.evaluate(
        "(() => { const t = document.querySelector('.map').data, h = t.find(t => t.z);"
        "return [h.z, h.text[3], h.x0, h.dx, h.y0, t.filter(t => /^floor:/.test(t.name)).length];"
        "})()"
    )
    assert drawn == [cells, ["soft", "soft", "rug", "rug"], -0.75, 0.5, -0.75, 2]
    assert "Several floors" in page.locator(".state").inner_text()
    page.locator(".previous").click()
    assert not page.evaluate("document.querySelector('.map').data.some(t => t.z)")
    assert (shown.errors, shown.overflow) == ([], 0)


def test_the_page_is_walked_by_keyboard_in_the_order_of_reading(browser, fitted):
    page = Shown(browser, write_report(fitted), 1440).page
    tops = []
    for _ in range(30):
        page.keyboard.press("Tab")
        tops.append(
            page.evaluate(
                "(() => { const e = document.activeElement, b = e.getBoundingClientRect();"
                "return e.className === 'skip' ? -1 : b.top + scrollY; })()"
            )
        )
    assert tops[0] == -1  # the link that skips the list of sections comes first
    assert all(b >= a - 40 for a, b in pairwise(tops)), tops
    shown = page.locator("#theme")
    shown.focus()
    page.keyboard.press("Enter")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"


def test_every_figure_and_picture_has_words_and_every_table_a_caption(browser, fitted):
    page = Shown(browser, write_report(fitted), 1440).page
    unnamed = (
        "[...document.querySelectorAll('.plot,img,svg.robot')]"
        ".filter(e => !(e.alt || e.ariaLabel || e.closest('[aria-label]'))).length"
    )
    assert page.evaluate(unnamed) == 0
    assert page.evaluate("[...document.querySelectorAll('table')].every(t => t.caption)")
    assert page.evaluate("document.querySelectorAll('section:empty').length") == 0


def test_the_page_prints_with_every_figure(browser, fitted, tmp_path):
    page = Shown(browser, write_report(fitted), 1440).page
    paper = page.pdf(format="A4")
    assert paper.startswith(b"%PDF")
    assert page.evaluate("[...document.querySelectorAll('.plot')].every(d => d.dataset.drawn)")


SELDOM = ("one_run", "heading_alone", "steered")
"""Kinds of pages that only the nightly tests make."""


@pytest.mark.parametrize(
    "kind",
    [
        *("motor", "check", *(kind for kind in CALIBRATED if kind not in SELDOM)),
        *(pytest.param(kind, marks=pytest.mark.nightly) for kind in SELDOM),
    ],
)
def test_pages_of_other_results_have_what_concerns_them(browser, small, tmp_path, kind):
    path = page_of(small, tmp_path, kind)
    for width in WIDTHS:
        shown = Shown(browser, path, width)
        shown.draw_all()
        assert (shown.errors, shown.requests, shown.overflow) == ([], [], 0)
    sections = [s.get_attribute("id") for s in shown.page.locator("section").all()]
    assert ("loads" in sections) is False
    assert ("numbers" in sections) is (kind != "check")
    if kind == "heading_alone":
        assert "no paths" in shown.page.locator("#paths").inner_text()
    elif kind in CALIBRATED:
        assert shown.page.locator(".player").count() == 1


def test_the_page_shows_a_posterior_where_there_is_one(browser, sampled, tmp_path):
    shutil.copytree(sampled[0], tmp_path / "out")
    result = invoke("report", tmp_path / "out", "--quiet")
    assert result.exit_code == 0, result.output
    assert str(tmp_path / "out" / REPORT) in result.stdout
    shown = Shown(browser, tmp_path / "out" / REPORT, 1440)
    shown.draw_all()
    assert shown.page.locator("[data-figure=pairs]").count() == 1
    assert "NOT converged" in shown.page.locator("#posterior").inner_text()
    assert shown.errors == []


def test_evidence_of_an_older_result_is_gathered_from_its_logs(small, fitted, tmp_path):
    folder, _ = small
    shutil.copytree(fitted, tmp_path / "out")
    (tmp_path / "out/evidence.json").unlink()
    result = invoke("report", tmp_path / "out", "--data", folder / "logs", "--quiet")
    assert result.exit_code == 0, result.output
    again, before = (read_evidence(p / "evidence.json") for p in (tmp_path / "out", fitted))
    assert [r.name for r in again.runs] == [r.name for r in before.runs]
    assert again.quarters == before.quarters


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("slipid.evidence/1", "slipid.evidence/9"), "its schema is"),
        (lambda text: text.replace('"runs":[', '"runs":[7,', 1), r"runs\[1\]: 7"),
        (lambda text: text[:100], "evidence.json"),
        (lambda text: re.sub('"data_hash":"....', '"data_hash":"0000', text), "of other logs"),
    ],
)
def test_damaged_evidence_is_refused_with_what_to_do(fitted, tmp_path, change, message):
    shutil.copytree(fitted, tmp_path / "out")
    path = tmp_path / "out/evidence.json"
    path.write_text(change(path.read_text()))
    with pytest.raises(DataError, match=message):
        write_report(tmp_path / "out")


def test_a_folder_without_results_is_2_and_a_message(tmp_path):
    result = invoke("report", tmp_path, "--quiet")
    assert result.exit_code == 2
    assert "slipid identify" in result.stderr
