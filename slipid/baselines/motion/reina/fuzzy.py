"""Sugeno's fuzzy inference answers by rules with constants that least squares trains.

Every input lies in 0..1 and belongs to `sets` triangular sets, whose peaks are evenly spaced and
whose memberships sum to one: for two sets, low is 1 - x and high is x. There is one rule for every
combination of sets of the inputs. A rule fires with the product of its memberships, and the answer
is the mean of the rules' consequents, weighted by how much they fire:

    y = sum_k f_k c_k,    f_k = prod_i mu_ik(x_i),    sum_k f_k = 1

Consequents are those of least squares, pulled a little towards the answer of a logical OR, so that
a rule that no sample fires still says what its words say.

Source: Takagi & Sugeno 1985, IEEE Transactions on Systems, Man, and Cybernetics 15(1); of order
zero.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

_PULL = 1.0
"""How many samples the answer of a logical OR counts as, in every rule."""


@dataclass(frozen=True, eq=False)
class Sugeno:
    """Fuzzy rules on a grid of sets.

    Attributes:
        sets: fuzzy sets of each input.
        consequents: answer of each rule; the sets of the last input change fastest.
    """

    sets: int
    consequents: Float[np.ndarray, " rule"]

    @classmethod
    def logical_or(cls, inputs: int, sets: int) -> "Sugeno":
        """Rules that answer with the peak of the highest set among their inputs."""
        peak = np.linspace(0.0, 1.0, sets)
        grid = np.stack(np.meshgrid(*[peak] * inputs, indexing="ij"), axis=-1)
        return cls(sets, grid.max(axis=-1).ravel())

    def strengths(self, x: Float[np.ndarray, "sample input"]) -> Float[np.ndarray, "sample rule"]:
        """How much each rule fires; the rules of a sample sum to one."""
        peak = np.linspace(0.0, 1.0, self.sets)
        member = np.maximum(1.0 - np.abs(x[..., None] - peak) * (self.sets - 1), 0.0)
        fires = member[:, 0]
        for more in member.transpose(1, 0, 2)[1:]:
            fires = (fires[:, :, None] * more[:, None, :]).reshape(len(x), -1)
        return fires

    def infer(self, x: Float[np.ndarray, "sample input"]) -> Float[np.ndarray, " sample"]:
        """Answer to each sample; inputs beyond 0..1 count as its ends."""
        return np.asarray(self.strengths(np.clip(x, 0.0, 1.0)) @ self.consequents)

    def trained(
        self, x: Float[np.ndarray, "sample input"], wanted: Float[np.ndarray, " sample"]
    ) -> "Sugeno":
        """The same sets with the consequents that come nearest to the wanted answers."""
        fires = self.strengths(np.clip(x, 0.0, 1.0))
        pulled = _PULL * np.eye(len(self.consequents))
        right = fires.T @ wanted + _PULL * self.consequents
        return replace(self, consequents=np.linalg.solve(fires.T @ fires + pulled, right))
