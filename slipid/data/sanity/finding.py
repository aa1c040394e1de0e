"""What was found wrong, or could not be checked: a sentence of it and a sentence of what to do."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from slipid.support.content import Content

Severity = Literal["wrong", "suspicious", "note"]
"""Wrong: do not fit before it is put right. Suspicious: look. Note: what could not be checked."""
ORDER: tuple[Severity, ...] = ("wrong", "suspicious", "note")
NAMED = 4
"""Runs that a sentence names before it counts the others."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found in runs.

    Attributes:
        kind: its name, such as `wheel_sign`; the rooms' files list them.
        found: what was seen, with numbers.
        remedy: what to do: which key to change, and to what; or None.
        severity: how bad it is.
        runs: names of the runs concerned; empty where all are.
    """

    kind: str
    found: str
    remedy: str | None
    severity: Severity
    runs: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = f" (in {listed(self.runs)})" if self.runs else ""
        return self.found + where + (f"; {self.remedy}" if self.remedy else "")

    def to_json(self) -> Content:
        """Its part of check.json."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "found": self.found,
            "remedy": self.remedy,
            "runs": list(self.runs),
        }


@dataclass(frozen=True)
class Words:
    """What was found, and what to do."""

    found: str
    remedy: str


def listed(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings with those first that forbid a fit."""
    return tuple(sorted(findings, key=lambda f: ORDER.index(f.severity)))


def wrong(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings that forbid a fit."""
    return tuple(f for f in findings if f.severity == "wrong")
