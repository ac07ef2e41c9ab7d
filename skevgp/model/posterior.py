"""The posterior at the end of a fit: `FittedPosterior` says what each approximation has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from ..data.blocks import Blocks
from ..data.rows import RawRows, Rows
from .conditioning import KnownRows
from .exact import ExactModel
from .local import LocalModel, values_by_output
from .model import SparseModel
from .parameters import Values
from .predictor import CoefficientPrior, Predictor
from .statistics import SufficientStatistics, Whitening
from .weights import WeightLikelihood


class FittedPosterior(Protocol):
    """An approximation of the posterior at the end of a fit. Another approximation is another class with these."""

    @property
    def sparse(self) -> SparseModel:
        """The sparse model. For an exact one, all rows are its inducing points."""

    @property
    def values(self) -> Values:
        """The parameters of the model."""

    @property
    def bound(self) -> float:
        """Lower bound on the log marginal likelihood of the residuals, in nats, in internal units."""

    @property
    def upper_bound(self) -> float:
        """Upper bound on the same."""

    @property
    def predictor(self) -> Predictor:
        """The predictor of residuals, in internal units."""

    @property
    def n_contrasts(self) -> np.ndarray:
        """Number of residuals (o,) whose density the bound is about."""

    def weight_likelihoods(
        self, prior: CoefficientPrior | None = None, rows: Rows | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output: under another prior, or for ``rows`` with other features."""

    def moved(self, prior: CoefficientPrior, rows: Rows) -> FittedPosterior:
        """The posterior for other features of the same rows, at the same values."""

    def updated(self, rows: Rows, weight: float, lowest_noise: np.ndarray) -> FittedPosterior:
        """The posterior with new rows: q is at its optimum for all of them.

        ``weight`` multiplies the log likelihood of the earlier rows. ``lowest_noise`` (o,) is the lowest noise of a
        sparse model, as a share of the scatter of the rows. Only an exact model may have less.
        """


class FromRows(NamedTuple):
    """What a pass over the rows computes without cancellation."""

    bound: float
    upper_bound: float
    predictor: Predictor


@dataclass(frozen=True)
class SparsePosterior:
    """A sparse model at the end of a fit. It keeps sums over the rows, and no rows."""

    sparse: SparseModel
    values: Values
    # For each set of inducing points, at ``values``.
    statistics: list[SufficientStatistics]
    # None: the statistics give the same. Digits then cancel if there is little noise.
    from_rows: FromRows | None = None
    # The whitening of each set of inducing points. None: it is computed.
    known_whitenings: tuple[Whitening, ...] | None = None

    @classmethod
    def of(
        cls,
        sparse: SparseModel,
        values: Values,
        blocks: Blocks,
        statistics: list[SufficientStatistics] | None = None,
    ) -> SparsePosterior:
        """The posterior with q at its optimum for all rows. ``statistics`` are computed if they are None."""
        if statistics is None:
            statistics = sparse.statistics(values, blocks)
        from_rows = FromRows(
            sparse.bound(values, statistics, blocks),
            sparse.upper_bound(values, statistics, blocks),
            sparse.at_optimum(values, statistics, blocks=blocks),
        )
        return cls(sparse, values, statistics, from_rows)

    def with_q(self, predictor: Predictor, bound: float) -> SparsePosterior:
        """The posterior with a q that is not at its optimum, and its bound."""
        return replace(self, from_rows=FromRows(bound, self.upper_bound, predictor))

    # --- as `FittedPosterior` says ------------------------------------------------------------------------------------

    @cached_property
    def bound(self) -> float:
        """Lower bound on the log marginal likelihood."""
        return self.sparse.bound(self.values, self.statistics) if self.from_rows is None else self.from_rows.bound

    @cached_property
    def upper_bound(self) -> float:
        """Upper bound on the same."""
        if self.from_rows is None:
            return self.sparse.upper_bound(self.values, self.statistics)
        return self.from_rows.upper_bound

    @property
    def predictor(self) -> Predictor:
        """The predictor of residuals, in internal units."""
        return self._at_optimum if self.from_rows is None else self.from_rows.predictor

    @cached_property
    def _at_optimum(self) -> Predictor:
        return self.sparse.at_optimum(self.values, self.statistics, self.known_whitenings)

    @property
    def n_contrasts(self) -> np.ndarray:
        """Number of residuals (o,) whose density the bound is about."""
        return np.full(len(self.values["noise"]), self.statistics[0].n_rows)

    def weight_likelihoods(
        self, prior: CoefficientPrior | None = None, rows: Rows | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output: under another prior, or for ``rows`` with other features."""
        sparse = self.sparse if prior is None else replace(self.sparse, prior=prior)
        statistics = self.statistics if rows is None else sparse.statistics(self.values, self._blocks(sparse, rows))
        return sparse.weight_likelihoods(self.values, statistics)

    def moved(self, prior: CoefficientPrior, rows: Rows) -> SparsePosterior:
        """The posterior for other features of the same rows, at the same values."""
        sparse = replace(self.sparse, prior=prior)
        return SparsePosterior.of(sparse, self.values, self._blocks(sparse, rows))

    def updated(self, rows: Rows, weight: float, lowest_noise: np.ndarray) -> SparsePosterior:
        """The posterior with new rows."""
        # Points that were all rows before are not all rows now.
        sparse, before = replace(self.sparse, complete=False), self.statistics
        whitenings = self.known_whitenings
        if whitenings is None:
            groups = self.predictor.groups
            whitenings = tuple(group.whitening for group in groups if isinstance(group.whitening, Whitening))
        if weight < 1.0:
            # The tight charge of earlier rows with another weight is not known from their sums.
            before = sparse.with_loose_charge(self.values, before)
        new = sparse.statistics(self.values, self._blocks(sparse, rows), whitenings)
        sums = [old.scaled(weight) + more for old, more in zip(before, new, strict=True)]
        return SparsePosterior(sparse, self.values, sums, known_whitenings=whitenings)

    # --- after rows were added ----------------------------------------------------------------------------------------

    def reweighted(self, prior: CoefficientPrior) -> SparsePosterior:
        """The posterior for another prior of the weights that has the same offset."""
        return replace(self, sparse=replace(self.sparse, prior=prior), from_rows=None)

    def _blocks(self, sparse: SparseModel, rows: Rows) -> Blocks:
        return sparse.blocks(rows, self.values["inducing_points"].shape[1])


@dataclass(frozen=True)
class ExactPosterior:
    """An exact model at the end of a fit, with its rows."""

    # The same model with all rows as inducing points: for new rows, and for an f that is orthogonal to the features.
    sparse: SparseModel
    exact: ExactModel
    values: Values
    bound: float
    predictor: Predictor

    @classmethod
    def of(cls, sparse: SparseModel, exact: ExactModel, values: Values) -> ExactPosterior:
        """The posterior at some values."""
        outputs = exact.outputs(values)
        bound = float(exact.log_likelihoods(values, outputs).sum())
        if sparse.variant.orthogonal:
            blocks = _blocks_of(sparse, exact, values)
            predictor = sparse.at_optimum(values, sparse.statistics(values, blocks), blocks=blocks)
        else:
            predictor = exact.predictor(values, outputs)
        return cls(sparse, exact, values, bound, predictor)

    @property
    def upper_bound(self) -> float:
        """The bound, which is the log marginal likelihood."""
        return self.bound

    @property
    def n_contrasts(self) -> np.ndarray:
        """Number of residuals (o,) whose density the bound is about."""
        return self.exact.n_contrasts

    def weight_likelihoods(
        self, prior: CoefficientPrior | None = None, rows: Rows | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, as of `SparsePosterior`."""
        raw = self.exact.rows if rows is None else _all(rows)
        sparse, exact = self._with(self.exact.prior if prior is None else prior, raw)
        if sparse.variant.orthogonal:
            statistics = sparse.statistics(self.values, _blocks_of(sparse, exact, self.values))
            return sparse.weight_likelihoods(self.values, statistics)
        return exact.weight_likelihoods(self.values)

    def moved(self, prior: CoefficientPrior, rows: Rows) -> ExactPosterior:
        """The posterior for other features of the same rows, at the same values."""
        return ExactPosterior.of(*self._with(prior, _all(rows)), self.values)

    def updated(self, rows: Rows, weight: float, lowest_noise: np.ndarray) -> FittedPosterior:
        """The posterior of the sparse model with new rows, with its local part if it has one."""
        lowest = lowest_noise * Rows.in_internal_units(self.exact.rows).scatter()
        values = self.values | {"noise": np.maximum(self.values["noise"], lowest)}
        n_neighbors, raw = self.sparse.variant.n_neighbors, self.exact.rows
        if n_neighbors:
            local = LocalModel.of(self.sparse, raw, n_neighbors, np.arange(len(raw.inputs)))
            return LocalPosterior.of(self.sparse, values, local).updated(rows, weight, lowest_noise)
        blocks, whitenings = _blocks_of(self.sparse, self.exact, values), tuple(self.sparse.whitenings(values))
        statistics = self.sparse.statistics(values, blocks, whitenings)
        before = SparsePosterior(self.sparse, values, statistics, known_whitenings=whitenings)
        return before.updated(rows, weight, lowest_noise)

    def _with(self, prior: CoefficientPrior, rows: RawRows) -> tuple[SparseModel, ExactModel]:
        """Both models with another prior, and with these rows."""
        # Features that are new have weights with a proper prior.
        vague = np.zeros(prior.scale.shape, dtype=bool)
        vague[:, : self.exact.vague.shape[1]] = self.exact.vague
        exact = replace(self.exact, prior=prior, vague=vague, rows=rows)
        return replace(self.sparse, prior=prior), exact


@dataclass(frozen=True)
class LocalPosterior:
    """A model with a local part at the end of a fit, with its rows (see `conditioning`)."""

    sparse: SparseModel
    values: Values
    local: LocalModel
    # The sparse model of the differences between rows and their neighbours. Each output has its inducing points.
    of_differences: SparsePosterior

    @classmethod
    def of(cls, sparse: SparseModel, values: Values, local: LocalModel) -> LocalPosterior:
        """The posterior at some values."""
        by_output = values_by_output(sparse, values)
        known = local.known(by_output)
        statistics = local.statistics(by_output, known, local.neighbours(known))
        whitenings = tuple(rows.whitening for rows in known)
        of_differences = SparsePosterior(local.sparse, by_output, statistics, known_whitenings=whitenings)
        # Threads end with the fit.
        return cls(sparse, values, replace(local, threads=None), of_differences)

    # --- as `FittedPosterior` says ------------------------------------------------------------------------------------

    @property
    def bound(self) -> float:
        """The log marginal likelihood of the approximation. It may be above or below that of the exact model."""
        return self.of_differences.bound

    @property
    def upper_bound(self) -> float:
        """No upper bound is known."""
        return np.inf

    @cached_property
    def predictor(self) -> Predictor:
        """The predictor of residuals, in internal units."""
        predictor, known = self.of_differences.predictor, self._known
        groups = [replace(group, near=rows) for group, rows in zip(predictor.groups, known, strict=True)]
        return replace(predictor, groups=tuple(groups))

    @property
    def n_contrasts(self) -> np.ndarray:
        """Number of residuals (o,) whose density the bound is about."""
        return self.of_differences.n_contrasts

    def weight_likelihoods(
        self, prior: CoefficientPrior | None = None, rows: Rows | None = None
    ) -> list[WeightLikelihood]:
        """The likelihood of the weights of each output, as of `SparsePosterior`."""
        if rows is None:
            return self.of_differences.weight_likelihoods(prior)
        return self.moved(self.sparse.prior if prior is None else prior, rows).weight_likelihoods()

    def moved(self, prior: CoefficientPrior, rows: Rows) -> LocalPosterior:
        """The posterior for other features of the same rows, at the same values."""
        sparse, raw = replace(self.sparse, prior=prior), _all(rows)
        return LocalPosterior.of(sparse, self.values, self.local.changed(sparse, raw))

    def updated(self, rows: Rows, weight: float, lowest_noise: np.ndarray) -> LocalPosterior:
        """The posterior with new rows, which are conditioned on earlier ones."""
        before, by_output = self.of_differences, self.of_differences.values
        local = self.local.with_more(_all(rows))
        known, n = local.known(by_output, before.known_whitenings), len(self.local.rows.inputs)
        new = local.statistics(by_output, known, local.neighbours(known, n), n)
        sums = [old.scaled(weight) + more for old, more in zip(before.statistics, new, strict=True)]
        return replace(self, local=local, of_differences=replace(before, statistics=sums))

    def reweighted(self, prior: CoefficientPrior) -> LocalPosterior:
        """The posterior for another prior of the weights that has the same offset."""
        local = replace(self.local, sparse=replace(self.local.sparse, prior=prior))
        of_differences = self.of_differences.reweighted(prior)
        return LocalPosterior(replace(self.sparse, prior=prior), self.values, local, of_differences)

    @property
    def _known(self) -> list[KnownRows]:
        return self.local.known(self.of_differences.values, self.of_differences.known_whitenings)


def _all(rows: Rows) -> RawRows:
    return rows.some(np.arange(len(rows)))


def _blocks_of(sparse: SparseModel, exact: ExactModel, values: Values) -> Blocks:
    """The rows of an exact model as blocks for its sparse twin."""
    return sparse.blocks(Rows.in_internal_units(exact.rows), values["inducing_points"].shape[1])
