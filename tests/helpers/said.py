"""A reporter that keeps what it is told."""

from __future__ import annotations

from slipid.support.progress import Reporter


class KeptMessages(Reporter):
    """Keeps sentences; stages and bars go nowhere.

    Attributes:
        lines: the sentences.
    """

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.lines: list[str] = []

    def line(self, text: str) -> None:
        self.lines.append(text)

    def stage(self, name: str) -> None:
        pass

    def advance(self, done: int | float, total: int | float, what: str | None = None) -> None:
        pass
