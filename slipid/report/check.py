"""What logs hold and can be expected to tell, in words and tables."""

from rich.text import Text

from slipid.report.page import Page, table, verdict
from slipid.support.content import Content


def show_check(page: Page, found: Content) -> None:
    """Write the content of check.json."""
    groups = table(("surface", "load", "session", "runs", "minutes", "headings", r"speeds \[m/s]"))
    for row in found["groups"]:
        groups.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"]),
            " ".join(f"{v:g}" for v in row["speeds"]),
        )
    page.table(groups)
    page.line("channels: " + ", ".join(found["channels"]))
    for note, count in found["notes"].items():
        page.line(f"repaired in {count} runs: {note}")
    before = table(
        ("parameter", "unit", "std after / before", "verdict"),
        "before any fit: what the logs can be expected to tell",
    )
    for path, e in (found["parameters"] | found["derived"]).items():
        if e["ratio"] is not None and "session_yaw" not in path:
            before.add_row(Text(path), e["unit"], f"{e['ratio']:.3f}", verdict(e["verdict"]))
    page.table(before)
    page.notes(found["messages"])
