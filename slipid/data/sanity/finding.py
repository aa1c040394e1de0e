"""Findings of the check: what is wrong or could not be checked, and the remedy."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from slipid.support.content import Content

Severity = Literal["wrong", "suspicious", "note"]
"""Wrong: do not fit before it is put right. Suspicious: look. Note: what could not be checked."""
ORDER: tuple[Severity, ...] = ("wrong", "suspicious", "note")
NAMED = 4
"""Runs that a sentence names before it counts the others."""


@dataclass(frozen=True)
class Finding:
    """One thing that the check found in runs.

    Attributes:
        kind: its name, such as `wheel_sign`; the rooms' files list them.
        found: what is wrong, with numbers.
        remedy: which key to change, and to what; or None.
        severity: how bad it is.
        runs: names of the runs concerned; empty where all are.
    """

    kind: str
    found: str
    remedy: str | None
    severity: Severity = "wrong"
    runs: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = f" (in {listed(self.runs)})" if self.runs else ""
        return self.found + where + (f"; {self.remedy}" if self.remedy else "")

    def explained(self, how: str, others: Iterable["Finding"] = ()) -> "Finding":
        """The finding with how it explains the logs, and the remedies of others that do as well."""
        more = "".join(f"; or, which explains these logs as well: {o.remedy}" for o in others)
        return replace(self, found=f"{self.found}: {how}", remedy=f"{self.remedy}{more}")

    def to_json(self) -> Content:
        """Its part of check.json."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "found": self.found,
            "remedy": self.remedy,
            "runs": list(self.runs),
        }


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
