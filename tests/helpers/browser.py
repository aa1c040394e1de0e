"""Pages in a real headless browser, if this machine has one."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTHS = (360, 1440)


@contextmanager
def chromium() -> Iterator:
    """Start the browser, or skip the test with the reason."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("no Chromium on the PATH; on Debian: apt-get install chromium")
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="no playwright; the extra `dev` brings it"
    )
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()


class Shown:
    """A page that is shown at some width, with everything that went wrong.

    Attributes:
        page: the page.
        errors: errors of scripts and of the console.
        requests: addresses of everything that was asked for, the page itself left out.
    """

    def __init__(self, browser, path: Path, width: int, scheme: str = "light"):
        self.context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme
        )
        self.context.grant_permissions(["clipboard-read", "clipboard-write"])
        self.page = self.context.new_page()
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", self._request)
        self.page.goto(path.resolve().as_uri())
        self.page.wait_for_selector("html[data-ready=yes]", timeout=60_000)

    def _console(self, message) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def _request(self, request) -> None:
        if not request.url.startswith(("data:", "blob:")) and not request.is_navigation_request():
            self.requests.append(request.url)

    def draw_all(self) -> int:
        """Scroll through the page until every figure is drawn; return the number of figures."""
        figures = self.page.locator(".plot")
        for k in range(figures.count()):
            figures.nth(k).scroll_into_view_if_needed()
            self.page.wait_for_function(
                "k => document.querySelectorAll('.plot')[k].querySelector('.main-svg')", arg=k
            )
        return figures.count()

    @property
    def overflow(self) -> int:
        """Pixels by which the page is wider than the screen."""
        return int(
            self.page.evaluate("document.documentElement.scrollWidth - document.body.clientWidth")
        )
