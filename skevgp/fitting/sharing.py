"""The groups of outputs that share a kernel, for ``sharing="auto"``."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from ..data.rows import LocalSource, Rows
from ..data.threads import BlockMap, side_by_side
from ..model.parameters import ParameterTable, Values
from ..solvers import LBFGS
from ..solvers.base import Tolerance
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from .fitted import Fitted
from .inducing import Placement
from .model import Model
from .parts import models_of
from .problem import Problem

# Largest loss of an output, as a share of the gain of its own Gaussian process over features and noise.
_LARGEST_LOSS = 0.01
# Largest share of ``max_time``.
_SHARE_OF_TIME = 0.5
# Variances of residuals below this are rounding errors, in squared internal units.
_CONSTANT = 1e-12
# Short fits: largest numbers of rows and points, iterations of the first fit and of the others, tolerance in nats.
_SAMPLE, _POINTS = 1000, 100
_FIRST_ITERATIONS, _FURTHER_ITERATIONS, _SHORT_TOL = 60, 25, 0.1
# Values that each output has by itself.
_PER_OUTPUT = ("signal", "noise", "coef_factors")


def with_groups(
    problem: Problem, rng: np.random.RandomState, monitor: Monitor, previous: Fitted | None = None
) -> Problem:
    """For ``sharing="auto"``, the same problem with groups: those of ``previous``, or those found by short fits.

    ``rng`` is not changed: a fit with the same groups given is the same fit. Ctrl-C raises KeyboardInterrupt, since
    there is no fit to keep yet.
    """
    if not (isinstance(problem.sharing, str) and problem.sharing == "auto"):
        return problem
    if problem.per_output:
        return replace(problem, sharing="none")
    if (
        previous is not None
        and previous.sharing_found
        and len(previous.units.target_unit) == len(problem.units.target_unit)
    ):
        return replace(problem, sharing=previous.sharing, sharing_found=True)
    groups = found_groups(problem, deepcopy(rng), part := monitor.silent().with_time(_SHARE_OF_TIME))
    if monitor.stopped:
        raise KeyboardInterrupt
    if part.stopped:
        return replace(problem, sharing="all")
    return replace(problem, sharing=groups, sharing_found=True)


def found_groups(problem: Problem, rng: np.random.RandomState, monitor: Monitor) -> list[list[int]]:
    """A partition of the outputs into groups that one kernel serves almost as well as own kernels do.

    Short fits to a sample of the rows decide it. The sum of the bounds, which a fit maximises, does not: outputs with
    little noise dominate it.
    """
    # The first short fit is of all outputs. Its inducing points are then fixed, so that the kernel alone makes a
    # difference. From there each output is fitted alone, and all outputs together. If sharing costs one of them more
    # than `_LARGEST_LOSS`, each output becomes a group. Pairs of groups with the most similar kernels are tried first.
    # They are joined if it costs no output too much, until no pair is left. Outputs that learned nothing from the
    # sample are the last group, or join the first group if they are constant. Constants that the features explain are a
    # group of their own: their kernel may be as smooth as the limits allow.
    everything = list(range(len(problem.units.target_unit)))
    if len(everything) == 1 or problem.max_iter == 0:
        return [everything]
    fits = _ShortFits.of(problem, rng, monitor)
    if fits.n_free == 0:
        return [everything]
    values_by_output = side_by_side(fits.alone, everything, problem.n_threads, monitor)
    bounds_alone = np.array([fits.bound(o, values) for o, values in enumerate(values_by_output)])
    # An own kernel has more parameters, and each must gain ½ log n nats (Schwarz 1978). If an output gains less, the
    # sample says nothing about it.
    gain, chance = bounds_alone - fits.without, 0.5 * fits.n_free * np.log(fits.n_rows)
    bearable = np.maximum(_LARGEST_LOSS * gain, chance)
    learned = [o for o in everything if gain[o] > chance]

    def suits(outputs: list[int], shared: list[Values]) -> bool:
        bounds = [fits.bound(o, values) for o, values in zip(outputs, shared, strict=True)]
        return bool((bounds_alone[outputs] - bounds <= bearable[outputs]).all())

    # Rows outside of the sample may say more. Other outputs must not dominate its kernel then: it has its own group.
    unknown = [o for o in everything if o not in learned]
    variance = problem.units.rows(problem.first_source).residuals.variance if unknown else np.empty(0)
    still = [o for o in unknown if problem.units.constant is not None and problem.units.constant[o]]
    hidden = [o for o in unknown if variance[o] > _CONSTANT and o not in still]
    constant = [o for o in unknown if o not in (*hidden, *still)]

    def completed(groups: list[list[int]]) -> list[list[int]]:
        return [sorted([*groups[0], *constant]), *groups[1:], *(group for group in (hidden, still) if group)]

    if not learned:
        return [group for group in ([o for o in everything if o not in still], still) if group]
    if suits(learned, fits.further(learned, fits.together)):
        return completed([learned])
    groups, apart = [[o] for o in learned], np.eye(len(everything), dtype=bool)
    while True:
        shapes = [fits.shape(values_by_output[group[0]]) for group in groups]
        pairs = [
            (float(shapes[i] @ shapes[j]), i, j)
            for i, j in combinations(range(len(groups)), 2)
            if not apart[np.ix_(groups[i], groups[j])].any()
        ]
        if not pairs:
            return completed(groups)
        _, i, j = max(pairs)
        outputs = sorted(groups[i] + groups[j])
        shared = fits.further(outputs, values_by_output)
        if suits(outputs, shared):
            groups[i] = outputs
            del groups[j]
            for o, values in zip(outputs, shared, strict=True):
                values_by_output[o] = values
        else:
            apart[np.ix_(groups[i], groups[j])] = True


@dataclass(frozen=True)
class _ShortFits:
    """Fits to a sample of the rows, all with the inducing points of a first fit to all outputs."""

    # With the sample for its rows, and with the inducing points.
    problem: Problem
    # The values of each output at the end of the first fit.
    together: list[Values]
    monitor: Monitor

    @classmethod
    def of(cls, problem: Problem, rng: np.random.RandomState, monitor: Monitor) -> _ShortFits:
        """Make the first fit."""
        raw = Rows(problem.first_source, lambda rows: rows).sample(_SAMPLE, rng)
        source = LocalSource.holding(raw)
        most = problem.placement.max_inducing or problem.placement.n_inducing
        placement = Placement("k-means", min(most, _POINTS))
        # Here outputs do not share their weights: only the kernel matters.
        units = replace(problem.units, prior=replace(problem.units.prior, shared=False))
        problem = replace(
            problem,
            source=source,
            ordinary=None,
            units=units,
            placement=placement,
            sharing="all",
            variant=replace(problem.variant, family="full"),
        )
        (model,) = models_of(problem, rng, monitor, BlockMap())
        together = _short_fit(model, model.table, _FIRST_ITERATIONS, monitor)
        points = together[0]["inducing_points"][0]
        return cls(replace(problem, placement=Placement(points, len(points))), together, monitor)

    @property
    def n_rows(self) -> int:
        """Number of rows of the sample."""
        return self.problem.source.n_rows

    @property
    def n_free(self) -> int:
        """Number of free parameters of k̃."""
        return int(self._each[0].table["hyperparameters"].free.sum())

    @property
    def without(self) -> np.ndarray:
        """The bound (o,) of each output without a Gaussian process."""
        return np.array([model.bound_alone for model in self._each])

    def alone(self, output: int) -> Values:
        """The values of an output that continues the first fit alone."""
        return self.further([output], self.together)[0]

    def further(self, outputs: list[int], starts: list[Values]) -> list[Values]:
        """The values of some outputs that continue together, from the mean of their kernels."""
        others = [[o] for o in range(len(starts)) if o not in outputs]
        (model,) = (model for model in self._planned([outputs, *others]) if model.rows.columns == outputs)
        chosen = [starts[o] for o in outputs]
        values = {name: np.concatenate([start[name] for start in chosen]) for name in _PER_OUTPUT if name in chosen[0]}
        values["hyperparameters"] = np.exp(np.mean([np.log(start["hyperparameters"]) for start in chosen], axis=0))
        return _short_fit(model, model.table.started_at(values), _FURTHER_ITERATIONS, self.monitor)

    def bound(self, output: int, values: Values) -> float:
        """The bound of an output at its values. Very low if it cannot be computed."""
        model = self._each[output]
        try:
            loss, _ = model.objective(model.table)(model.table.started_at(values).start())
        except NotPositiveDefiniteError:
            loss = np.inf
        return -model.rows.total * loss if np.isfinite(loss) else -np.finfo(float).max

    def shape(self, values: Values) -> np.ndarray:
        """k̃ at the inducing points as a vector of length 1. Products are alignments (Cristianini et al. 2001)."""
        kernel, (points,) = self._each[0].sparse.kernel, values["inducing_points"]
        K = kernel.at(values["hyperparameters"], points).matrix()
        return np.ravel(K) / np.linalg.norm(K)

    @cached_property
    def _each(self) -> list[Model]:
        """A model for each output."""
        return self._planned([[o] for o in range(len(self.together))])

    def _planned(self, groups: list[list[int]]) -> list[Model]:
        """A model for each group."""
        models = models_of(replace(self.problem, sharing=groups), np.random.RandomState(0), self.monitor, BlockMap())
        return [replace(model, table=model.table.changed("inducing_points", fixed=True)) for model in models]


def _short_fit(model: Model, table: ParameterTable, n_iter: int, monitor: Monitor) -> list[Values]:
    """The values of each output after at most ``n_iter`` iterations."""
    tolerance = Tolerance(_SHORT_TOL / model.rows.total)
    minimum = LBFGS().minimise(model.objective(table), table.start(), table.limits(), n_iter, tolerance, monitor)
    values = table.values(minimum.x)
    outputs = range(len(values["noise"]))
    return [values | {name: values[name][[o]] for name in _PER_OUTPUT if name in values} for o in outputs]
