"""Types of what a page reads of fit.json and of the files of later commands."""

from dataclasses import field
from typing import Annotated, Any

from pydantic import Field
from pydantic.dataclasses import dataclass

from slipid.infer.result_content import OPEN, Count, NumberContent, Pair
from slipid.infer.verdicts.disputed import LoadComparison

Text = Annotated[str, Field(min_length=1)]


@dataclass(frozen=True, config=OPEN)
class FlatContent:
    """Combination of parameters about which the data have no information."""

    paths: list[str]
    formula: str
    remedy: str


@dataclass(frozen=True, config=OPEN)
class BehindContent:
    """Differences to the error of the best model, with standard errors."""

    behind: dict[str, Pair]


@dataclass(frozen=True, config=OPEN)
class ShownFitContent:
    """Content of fit.json."""

    converged: bool
    reason: str
    parameters: dict[str, NumberContent]
    flat: list[FlatContent]
    settings: dict[str, Any]
    selection: dict[str, BehindContent] = field(default_factory=dict)
    load_comparisons: list[LoadComparison] = field(default_factory=list)


@dataclass(frozen=True, config=OPEN)
class WorstContent:
    """Convergence of the worst coordinate of a posterior."""

    r_hat: float
    effective_draws: float


@dataclass(frozen=True, config=OPEN)
class SampleContent:
    """Content of sample.json."""

    converged: bool
    reason: str
    ensembles: Count
    walkers: Count
    steps: Count
    worst: WorstContent
    posterior_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True, config=OPEN)
class ProposedRunContent:
    """A proposed run."""

    floor: str
    load: str
    heading_deg: float
    speed: float
    turn_rate: float
    seconds: float


@dataclass(frozen=True, config=OPEN)
class DesignContent:
    """Content of design.json."""

    runs: list[ProposedRunContent]
    messages: list[str]


@dataclass(frozen=True, config=OPEN)
class ScoreContent:
    """Scores of a model on a floor."""

    endpoint_error_over_path_mean: float
    heading_error_median_deg: float | None
    coverage90: float | None
    runs: Count


@dataclass(frozen=True, config=OPEN)
class ValidationContent:
    """Content of validation.json."""

    summary: dict[str, dict[str, ScoreContent]]

    def __post_init__(self) -> None:
        """Raise `ValueError` if there are no scores."""
        if not any(self.summary.values()):
            raise ValueError("no scores of a model")


@dataclass(frozen=True, config=OPEN)
class RankedContent:
    """A model of a comparison."""

    difference: float
    se_clustered: float | None
    endpoint_error: float


@dataclass(frozen=True, config=OPEN)
class RankingContent:
    """Models of a comparison on a floor."""

    models: Annotated[dict[str, RankedContent], Field(min_length=1)]
    sentence: str


@dataclass(frozen=True, config=OPEN)
class QuestionContent:
    """Answer of a comparison to a question."""

    floors: dict[str, RankingContent]


@dataclass(frozen=True, config=OPEN)
class ComparisonContent:
    """Content of comparison.json."""

    questions: dict[str, QuestionContent]


@dataclass(frozen=True, config=OPEN)
class TrialRowContent:
    """Errors of a controller in a trial."""

    closure_error_median: float
    cross_track_rmse: float
    heading_error_deg: float
    finished_share: float
    runs: Count
    interval90: dict[str, Pair | None]

    def __post_init__(self) -> None:
        """Raise `ValueError` if the key of the median's interval is missing."""
        if "closure_error_median" not in self.interval90:
            raise ValueError("interval90 lacks closure_error_median")


@dataclass(frozen=True, config=OPEN)
class TrialContent:
    """Content of trial.json."""

    summary: Annotated[dict[str, TrialRowContent], Field(min_length=1)]
    controllers: dict[str, str]
    verdict: Text
    path: str
    speed_m_s: float
    plant: str
    map: str
    site: str | None = None


LATER: dict[str, type] = {
    "validation": ValidationContent,
    "comparison": ComparisonContent,
    "trial": TrialContent,
    "design": DesignContent,
    "sample": SampleContent,
}
"""Type of the content of each later file, keyed by the file's name without .json."""
COMMANDS = {"validation": "validate", "comparison": "compare"}
"""Commands that write the files that are named otherwise."""
