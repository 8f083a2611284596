"""Which model of the motion the pairs support: rivals, compared by what they explain at the price of their unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from photonpano.motion.adjustment import Cost
from photonpano.motion.model import MotionModel

# An unknown of an exposure must lower the squared residuals by this much, in units of what homographies leave: noise, which
# pairs have in common, lets it lower them by 0.3 to 2. One that all exposures share must lower them by that much in units of
# photon noise: it explains what all pairs do alike.
_PRICE, _SHARED = 8.0, 24.0
# A model suffices if homographies lower the squared residuals by less than this for each unknown that they have more.
_EXPLAINED = 20.0


@dataclass(frozen=True, slots=True)
class Rival:
    """How well a model explains the pairs of a level."""

    chi2: float  # reduced chi-square: mean square of the whitened residuals, 1 where they are photon noise
    unknowns: int
    # by how much each unknown that homographies have more lowers the squared residuals, in units of what homographies leave
    gain: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """How well rival models explain the pairs of a level."""

    rivals: Mapping[str, Rival]  # by the names of the models

    @classmethod
    def of(cls, costs: Mapping[MotionModel, Cost]) -> Evidence:
        """Compare the costs of models, each fitted to the same pairs."""
        free, scale = _richest(costs), _scale(costs)
        return cls(
            {
                model.name: Rival(
                    cost.squares / max(cost.left, 1),
                    cost.unknowns,
                    (cost.squares - free.squares) / max(free.unknowns - cost.unknowns, 1) / scale,
                )
                for model, cost in costs.items()
            }
        )

    def suffices(self, model: str) -> bool:
        """Return whether homographies explain the pairs no better than a model."""
        return self.rivals[model].gain < _EXPLAINED


def likeliest(costs: Mapping[MotionModel, Cost]) -> MotionModel:
    """Return the model that explains most at the price of its unknowns.

    Shifts without roll are a rival of those with roll alone: on the sphere around a camera that turns, they do not exist.
    """
    scale = _scale(costs)

    def score(model: MotionModel) -> float:
        cost = costs[model]
        return (cost.squares - cost.explained + _SHARED * cost.shared) / scale + _PRICE * (cost.unknowns - cost.shared)

    best = min((model for model in costs if model.kind != "translation"), key=score)
    shifts = (model for model in costs if model.kind == "translation" and best.kind == "euclidean")
    return min((best, *shifts), key=score)


def _richest(costs: Mapping[MotionModel, Cost]) -> Cost:
    return max(costs.values(), key=lambda cost: cost.unknowns)


def _scale(costs: Mapping[MotionModel, Cost]) -> float:
    free = _richest(costs)
    return max(free.squares / max(free.left, 1), 1.0)
