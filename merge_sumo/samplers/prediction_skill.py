"""P(fail) from the predictions of a twin, weighted by the skill of its predictions so far.

A *predictor*, which knows the POVs and has observed the VUT, rolls cases out and predicts the gap
at M, in units of the limit. It has experts of several kinds, and of each several members who know
different things, so that they disagree where they guess. How much is to be made of what they say is
in the record: what they had said of the cases that have run since.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtr

from merge_sumo.metrics.prediction import NO_GAP, Prediction
from merge_sumo.metrics.score import Outcome
from merge_sumo.samplers.greedy import Proposal
from merge_sumo.scenario.case import FloatArray

Known = Sequence[tuple[Outcome, Prediction]]

WIDTHS: Final = np.array([0.01, 0.03, 0.1, 0.35, 1.2])
"""How far gaps may be off, as standard deviations on the scale of `compressed`."""
REACH: Final = 9.0
"""Length of that scale, on which a gap may be anywhere where nobody knows anything."""
PRIOR: Final = np.array([0.5, 0.5, 1.0, 1.0, 1.0, 0.5])
"""Cases that speak for each of the widths, and for anywhere, before there is a record."""
EM_ROUNDS: Final = 12
"""Of expectation and maximisation, which learns how often gaps are how far off."""
HALF_LIFE: Final = 40.0
"""Cases after which what was predicted counts half: a predictor learns."""
FORGOTTEN: Final = 2000
"""Cases after which what was predicted counts nothing: that is below the last digit of a sum."""
OTHER_LEVELS: Final = 0.4
"""What a case at another level counts: it is the same VUT."""
TEMPERED: Final = 0.5
"""What a case counts for one expert against the other: cases of a batch are alike."""
SURE: Final = 0.005
"""Chances nearer to 0 or 1 than this are not told apart."""
TRUSTED_FROM: Final = 100
"""Cases, the last ones, by which gains are set right."""
WORTHLESS: Final = 0.05
JUDGED_FROM: Final = 40
"""A predictor with less weight than that, after so many cases, is not asked for candidates."""
BROKEN: Final = 0.5
BROKEN_BATCHES: Final = 4
PROMISED_BEFORE: Final = 0.25
"""Slope of the verdicts over P(fail) below which picks are compared with cases from anywhere, the
fewest batches that it is judged by, as cases of a batch are alike (the first one of design2
promises .7 and keeps nothing, the fifth keeps all), and sum of the squares of P(fail) that speaks
for a slope of 1 before there is a record."""
EDGE: Final = float(np.arcsinh(1.0))
"""The limit of a failure on the scale of `compressed`."""


class Predictor(Protocol):
    """Predicts the gaps of cases; a pure function of the outcomes told so far."""

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes, and their motions, (T + 1, A, 3), by index."""

    def can_predict(self, level: int) -> bool:
        """Return whether the outcomes so far suffice to predict cases of a level."""

    def predict(
        self,
        level: int,
        points: FloatArray,
        *,
        screening: int | None = None,
        held_out: Sequence[int] = (),
    ) -> FloatArray:
        """Return the signed gaps of cases (`Outcome.signed_gap`), (E, G, n); NaN where none is.

        Args:
            level: that of the POV.
            points: cases, (n, d), of the unit cube.
            screening: the one expert of which one member predicts, (1, 1, n).
            held_out: indices of the cases where they were told before: each is predicted by a
                member of each expert that has not learned from the case, (E, n).
        """


def compressed(gap: FloatArray) -> FloatArray:
    """Return gaps on a scale that is logarithmic where they are large."""
    return np.asarray(np.arcsinh(np.nan_to_num(gap, nan=NO_GAP)))


class PredictionSkill:
    """The skill of the predictions so far, and P(fail) of the next ones that follows from it.

    Attributes:
        experts: weight of each expert, (E,); (1,) for all of them without predictions so far.
        twin: weight of the twin against the surrogate where members disagree, and where they
            agree on the verdict, (2,).
        trust: factor of the gains. Picks have a large P(fail), so P(fail) is biased upwards among
            them; the outcomes of the last picks give the bias.
        kept: how much of what was promised came, at most 1: the slope of the verdicts over P(fail).
    """

    def __init__(
        self,
        outcomes: Sequence[Outcome],
        level: int,
        limit_m: float,
        replayed: Mapping[int, FloatArray] | None = None,
    ) -> None:
        """Learn from outcomes in the order of their index; predictions are recorded in m.

        `limit_m` is the limit of the scenario, the unit of gaps. `replayed` are gaps, (E,), by the
        index of a case, of members that did not learn from it.
        """
        outcomes = outcomes[-FORGOTTEN:]
        known = [(o, o.prediction) for o in outcomes if o.prediction is not None]
        self._limit_m = limit_m
        self._mixture = (PRIOR / PRIOR.sum())[None]
        self.experts, self.twin, self.trust = np.ones(1), np.array([0.5, 0.5]), 1.0
        self._cases, self.kept = len(known), 1.0
        self._batches = len({outcome.batch for outcome, _ in known})
        if known:
            self._learn_weights(known, self._weights([o for o, _ in known], level))
            self.kept = self._kept(known, level)
            last = [one for one in known if one[0].case.level == level][-TRUSTED_FROM:]
            failed, predicted = (sum(o.failed for o, _ in last), sum(f.p_fail for _, f in last))
            self.trust = min((failed + 1.0) / (predicted + 1.0), 1.0)
        self._learn_errors(outcomes, level, replayed or {})

    @property
    def is_worthless(self) -> bool:
        """Whether the predictions so far show no skill for this VUT."""
        return self._cases >= JUDGED_FROM and bool((self.twin < WORTHLESS).all())

    @property
    def breaks_promises(self) -> bool:
        """Whether less than half of the failures came that the predictions so far promised."""
        return self._batches >= BROKEN_BATCHES and self.kept < BROKEN

    @property
    def is_doubted(self) -> bool:
        """Whether, after many cases, the twin has no weight where its members disagree.

        The surrogate then decides, with its own calibration, and no case of a batch is spent on
        information for the twin.
        """
        return self._cases >= TRUSTED_FROM and bool(self.twin[0] < WORTHLESS)

    def expert(self, rng: np.random.Generator) -> int:
        """Return an expert drawn by weight."""
        return int(rng.choice(len(self.experts), p=self.experts))

    def chance(self, gaps: FloatArray, expert: int | None = None) -> FloatArray:
        """Return P(fail), (n,), of cases with predicted gaps, (E, G, n), of one expert or all."""
        said = compressed(gaps)[..., None]
        failing = ndtr((EDGE - said) / WIDTHS) - ndtr((-EDGE - said) / WIDTHS)
        experts, _, n, _ = said.shape
        anywhere = np.full((experts, n, 1), 2.0 * EDGE / REACH)
        by_width = np.concatenate([failing.mean(axis=1), anywhere], axis=-1)
        of = slice(None) if expert is None or len(self.experts) == 1 else [expert]
        mixture = np.broadcast_to(self._mixture[of], (experts, len(PRIOR)))
        weights = np.broadcast_to(self.experts[of], experts)
        by_expert = np.einsum("enw,ew->en", by_width, mixture)
        return np.asarray(np.average(by_expert, axis=0, weights=weights), dtype=np.float64)

    def mixed(self, gaps: FloatArray, p_twin: FloatArray, p_surrogate: FloatArray) -> FloatArray:
        """Return P(fail), (n,), of twin and surrogate together."""
        weight = self.twin[self._agreed(gaps).astype(np.int64)]
        mixed: FloatArray = weight * p_twin + (1.0 - weight) * p_surrogate
        return mixed

    def disagreement(self, gaps: FloatArray) -> FloatArray:
        """Return the information in cases, (n,), by gaps, (E, G, n).

        Large where members disagree on a gap that may be small.
        """
        said = compressed(gaps).reshape(-1, gaps.shape[-1])
        return np.asarray(said.std(axis=0) * np.exp(-0.25 * np.square(np.median(said, axis=0))))

    def prediction(
        self, gaps: FloatArray, p_twin: float, p_surrogate: float, p_fail: float
    ) -> Prediction:
        """Return the prediction of a case by its gaps, (E, G), as it is recorded."""
        return Prediction.of(self._limit_m * gaps, p_twin, p_surrogate, p_fail)

    def annotated(self, proposal: Proposal, gaps: FloatArray) -> Proposal:
        """Return a proposal of the surrogate's with what rollouts say of it, which may change."""
        said = tuple(
            self.prediction(gaps[..., i], float(p), float(chance), float(chance))
            for i, (p, chance) in enumerate(
                zip(self.chance(gaps), proposal.probability, strict=True)
            )
        )
        return replace(proposal, predictions=said)

    def _agreed(self, gaps: FloatArray) -> NDArray[np.bool_]:
        """Return where all members predict the same verdict, (n,), by gaps, (E, G, n)."""
        gaps = np.abs(np.nan_to_num(gaps, nan=NO_GAP)).reshape(-1, gaps.shape[-1])
        failing = gaps < 1.0
        return np.asarray(failing.all(axis=0) | ~failing.any(axis=0))

    def _kept(self, known: Known, level: int) -> float:
        """Return the slope of the verdicts over P(fail), at most 1; of all levels, as weighted."""
        weight = self._weights([o for o, _ in known], level)
        failed = np.array([o.failed for o, _ in known])
        promised = np.array([said.p_fail for _, said in known])
        came = float(weight @ (promised * failed)) + PROMISED_BEFORE
        return min(came / (float(weight @ np.square(promised)) + PROMISED_BEFORE), 1.0)

    def _learn_errors(
        self, outcomes: Sequence[Outcome], level: int, replayed: Mapping[int, FloatArray]
    ) -> None:
        """Learn how far experts are off, and which of them is to be believed.

        How far they are off is seen where they predicted; where nobody did, and to tell them from
        each other, what they now make of cases that they have not learned from has to do.
        """
        off: list[tuple[Outcome, FloatArray]] = []
        own: list[tuple[Outcome, FloatArray]] = []
        for outcome in outcomes:
            said = replayed.get(outcome.index)
            if outcome.prediction is not None:
                off.append((outcome, outcome.prediction.gaps_m / self._limit_m))
            elif said is not None:
                off.append((outcome, said[:, None]))
            if said is not None:
                own.append((outcome, said[:, None]))
        if off:
            density, weight = self._densities(off), self._weights([o for o, _ in off], level)
            self._mixture = np.array([_mixture(of, weight) for of in density])
        judges = own or off
        if judges:
            weight = self._weights([outcome for outcome, _ in judges], level)
            density = self._densities(judges)
            evidence = [weight @ np.log(of @ _mixture(of, weight)) for of in density]
            lead = np.exp(TEMPERED * (np.array(evidence) - max(evidence)))
            self.experts = lead / lead.sum()

    def _densities(self, predicted: Sequence[tuple[Outcome, FloatArray]]) -> FloatArray:
        """Return how likely each gap was with every width, and anywhere, (E, N, widths + 1).

        By predicted gaps, (E, G) of each case: a member of an expert is as good as any other.
        """
        true = compressed(np.array([o.signed_gap for o, _ in predicted], dtype=np.float64))
        experts = len(predicted[0][1])
        densities = np.full((experts, len(predicted), len(WIDTHS) + 1), 1.0 / REACH)
        members = np.array([gaps.shape[1] for _, gaps in predicted])
        for count in np.unique(members).tolist():
            places = np.flatnonzero(members == count)
            gaps = np.array([predicted[place][1] for place in places.tolist()])
            off = (true[places, None, None] - compressed(gaps))[..., None]
            density = np.exp(-0.5 * np.square(off / WIDTHS)) / (WIDTHS * np.sqrt(2.0 * np.pi))
            densities[:, places, :-1] = density.mean(axis=2).transpose(1, 0, 2)
        return densities

    @staticmethod
    def _weights(outcomes: Sequence[Outcome], level: int) -> FloatArray:
        """Return what outcomes count, (N,): the last ones, and those of the level, most."""
        own = np.array([outcome.case.level == level for outcome in outcomes])
        age = np.arange(len(outcomes))[::-1]
        return np.asarray(0.5 ** (age / HALF_LIFE) * np.where(own, 1.0, OTHER_LEVELS))

    def _learn_weights(self, known: Known, weight: FloatArray) -> None:
        """Learn where the rollouts, and where the surrogate, predicted the verdicts better."""
        failed = np.array([o.failed for o, _ in known])
        same = self._agreed(np.stack([told.gaps_m / self._limit_m for _, told in known], axis=-1))
        chances = np.array([(told.p_twin, told.p_surrogate) for _, told in known])
        right = np.where(failed[:, None], chances, 1.0 - chances)
        evidence = weight[:, None] * np.log(np.clip(right, SURE, 1.0 - SURE))
        for place, where in enumerate((~same, same)):
            twin, surrogate = evidence[where].sum(axis=0)
            self.twin[place] = expit(np.clip(twin - surrogate, -30.0, 30.0))


def _mixture(density: FloatArray, weight: FloatArray) -> FloatArray:
    """Return how often which width is the right one, by densities, (N, widths + 1)."""
    mixture: FloatArray = PRIOR / PRIOR.sum()
    for _ in range(EM_ROUNDS):
        share = density * mixture
        share /= share.sum(axis=1, keepdims=True)
        mixture = PRIOR + weight @ share
        mixture /= mixture.sum()
    return mixture
