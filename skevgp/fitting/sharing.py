"""Which outputs share a model, where that is to be found."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from ..data.rows import LocalSource, Rows
from ..data.threads import BlockMap, side_by_side
from ..model.parameters import ParameterTable, Values
from ..solvers import LBFGS
from ..solvers.lbfgs import Tolerance
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from .inducing import Placement
from .model import Model, models_of
from .problem import Problem

if TYPE_CHECKING:
    from .fit import Fitted

# Of what its own Gaussian process gains an output over features and noise.
_LARGEST_LOSS = 0.01
# At the most, if the time is limited.
_SHARE_OF_TIME = 0.5
# In squared internal units: rounding.
_CONSTANT = 1e-12
# By which groups are found: at most so many rows and points; iterations of the first fit and of others; in nats.
_SAMPLE, _POINTS = 1000, 100
_FIRST_ITERATIONS, _FURTHER_ITERATIONS, _SHORT_TOL = 60, 25, 0.1


def with_groups(
    problem: Problem, rng: np.random.RandomState, monitor: Monitor, previous: Fitted | None = None
) -> Problem:
    """With ``sharing="auto"`` the same problem with groups, those that ``previous`` found if there are any.

    Parameters
    ----------
    problem : Problem
    rng : RandomState
        Which stays as it is: a fit with these groups given is the same fit.
    monitor : Monitor
        Which Ctrl-C stops, and which is told of no iteration.
    previous : Fitted, default=None
        A fit to other rows.

    Returns
    -------
    problem : Problem

    Raises
    ------
    KeyboardInterrupt
        There is nothing yet to keep.
    """
    if not (isinstance(problem.sharing, str) and problem.sharing == "auto"):
        return problem
    if problem.per_output:
        return replace(problem, sharing="none")
    if previous is not None and previous.found and len(previous.units.target_unit) == len(problem.units.target_unit):
        return replace(problem, sharing=previous.sharing, found=True)
    groups = found_groups(problem, deepcopy(rng), part := monitor.silent().with_time(_SHARE_OF_TIME))
    if monitor.stopped:
        raise KeyboardInterrupt
    if part.stopped:
        return replace(problem, sharing="all")
    return replace(problem, sharing=groups, found=True)


def found_groups(problem: Problem, rng: np.random.RandomState, monitor: Monitor) -> list[list[int]]:
    """Which outputs to fit together: those that one kernel serves, each of them nearly as well as one of its own.

    (The sum of their bounds, which a fit maximises, does not show it: outputs with little noise rule it.) What a kernel
    is worth is seen in short fits to a sample of the rows. The first is of all outputs. Its inducing points then stay,
    so that what follows is a matter of the kernel and not of luck: from there each output is fitted alone, and all
    together. If that costs one of them too much (`_LARGEST_LOSS`), each becomes a group, and of all pairs of groups
    those with the kernels most alike are tried first, and joined if it costs no output too much, until none is left.
    Outputs that learned nothing from the sample are the last group, or if they are constant in the first one. Constants
    of which nothing is left over have a group of their own: their kernel is as smooth as may be.

    Parameters
    ----------
    problem : Problem
    rng : RandomState
    monitor : Monitor
        Which Ctrl-C stops.

    Returns
    -------
    groups : list of list of int
        A partition of the outputs.
    """
    everything = list(range(len(problem.units.target_unit)))
    if len(everything) == 1 or problem.max_iter == 0:
        return [everything]
    fits = _ShortFits.of(problem, rng, monitor)
    if fits.n_free == 0:
        return [everything]
    found = side_by_side(fits.alone, everything, problem.n_threads, monitor)
    own = np.array([fits.bound(o, values) for o, values in enumerate(found)])
    # A kernel of its own has more parameters, too, each worth ½ log n nats (Schwarz 1978): of what gains less, the
    # sample shows nothing.
    gain, chance = own - fits.without, 0.5 * fits.n_free * np.log(fits.n_rows)
    bearable = np.maximum(_LARGEST_LOSS * gain, chance)
    learned = [o for o in everything if gain[o] > chance]

    def suits(outputs: list[int], shared: list[Values]) -> bool:
        bounds = [fits.bound(o, values) for o, values in zip(outputs, shared, strict=True)]
        return bool((own[outputs] - bounds <= bearable[outputs]).all())

    # Rows that were not drawn may show it, and then the others must not rule its kernel: a group of its own.
    unknown = [o for o in everything if o not in learned]
    variance = problem.units.rows(problem.source).residuals.variance if unknown else np.empty(0)
    still = [o for o in unknown if problem.units.constant is not None and problem.units.constant[o]]
    hidden = [o for o in unknown if variance[o] > _CONSTANT and o not in still]
    constant = [o for o in unknown if o not in (*hidden, *still)]

    def completed(groups: list[list[int]]) -> list[list[int]]:
        return [sorted([*groups[0], *constant]), *groups[1:], *(own for own in (hidden, still) if own)]

    if not learned:
        return [own for own in ([o for o in everything if o not in still], still) if own]
    if suits(learned, fits.further(learned, fits.together)):
        return completed([learned])
    groups, apart = [[o] for o in learned], np.eye(len(everything), dtype=bool)
    while True:
        shapes = [fits.shape(found[group[0]]) for group in groups]
        pairs = [
            (float(shapes[i] @ shapes[j]), i, j)
            for i, j in combinations(range(len(groups)), 2)
            if not apart[np.ix_(groups[i], groups[j])].any()
        ]
        if not pairs:
            return completed(groups)
        _, i, j = max(pairs)
        outputs = sorted(groups[i] + groups[j])
        shared = fits.further(outputs, found)
        if suits(outputs, shared):
            groups[i] = outputs
            del groups[j]
            for o, values in zip(outputs, shared, strict=True):
                found[o] = values
        else:
            apart[np.ix_(groups[i], groups[j])] = True


@dataclass(frozen=True)
class _ShortFits:
    """Fits to a sample of the rows, all with the inducing points where a first one of all outputs ended.

    A fit is told as the values of each of its outputs.

    Attributes
    ----------
    problem : Problem
        Of the sample and the points.
    together : list of dict
        Where the first ended.
    monitor : Monitor
    """

    problem: Problem
    together: list[Values]
    monitor: Monitor

    @classmethod
    def of(cls, problem: Problem, rng: np.random.RandomState, monitor: Monitor) -> _ShortFits:
        """With the first fit."""
        raw = Rows(problem.source, lambda rows: rows).sample(_SAMPLE, rng)
        source = LocalSource.holding(raw)
        most = problem.placement.max_inducing or problem.placement.n_inducing
        placement = Placement("k-means", min(most, _POINTS))
        # Each output has weights of its own here, if it shares them or not: what is asked is which kernel it wants.
        units = replace(problem.units, prior=replace(problem.units.prior, shared=False))
        problem = replace(problem, source=source, units=units, placement=placement, sharing="all", family="full")
        (model,) = models_of(problem, rng, monitor, BlockMap())
        together = _short_fit(model, model.table, _FIRST_ITERATIONS, monitor)
        points = together[0]["inducing_points"][0]
        return cls(replace(problem, placement=Placement(points, len(points))), together, monitor)

    @property
    def n_rows(self) -> int:
        return self.problem.source.n_rows

    @property
    def n_free(self) -> int:
        """Parameters of k̃ that are not fixed."""
        return int(self._each[0].table["hyperparameters"].free.sum())

    @property
    def without(self) -> np.ndarray:
        """The bound (o,) of each output without a Gaussian process."""
        return np.array([model.bound_alone for model in self._each])

    def alone(self, output: int) -> Values:
        """An output, from where the first fit ended."""
        return self.further([output], self.together)[0]

    def further(self, outputs: list[int], starts: list[Values]) -> list[Values]:
        """Some outputs, from the values of all: from the mean of their kernels."""
        others = [[o] for o in range(len(starts)) if o not in outputs]
        (model,) = (own for own in self._planned([outputs, *others]) if own.rows.columns == outputs)
        own = [starts[o] for o in outputs]
        values = {name: np.concatenate([one[name] for one in own]) for name in ("signal", "noise")}
        values["hyperparameters"] = np.exp(np.mean([np.log(one["hyperparameters"]) for one in own], axis=0))
        return _short_fit(model, model.table.started_at(values), _FURTHER_ITERATIONS, self.monitor)

    def bound(self, output: int, values: Values) -> float:
        """Of an output with its values; very low where it cannot be computed."""
        model = self._each[output]
        try:
            loss, _ = model.objective(model.table)(model.table.started_at(values).start())
        except NotPositiveDefiniteError:
            loss = np.inf
        return -model.rows.total * loss if np.isfinite(loss) else -np.finfo(float).max

    def shape(self, values: Values) -> np.ndarray:
        """k̃ at the points, as a vector of length 1: products are alignments (Cristianini et al. 2001)."""
        kernel, (points,) = self._each[0].sparse.kernel, values["inducing_points"]
        K = kernel.at(np.log(values["hyperparameters"]), points).matrix()
        return np.ravel(K) / np.linalg.norm(K)

    @cached_property
    def _each(self) -> list[Model]:
        return self._planned([[o] for o in range(len(self.together))])

    def _planned(self, groups: list[list[int]]) -> list[Model]:
        models = models_of(replace(self.problem, sharing=groups), np.random.RandomState(0), self.monitor, BlockMap())
        return [replace(model, table=model.table.changed("inducing_points", fixed=True)) for model in models]


def _short_fit(model: Model, table: ParameterTable, n_iter: int, monitor: Monitor) -> list[Values]:
    """The values of each output where so many iterations lead."""
    tolerance = Tolerance(_SHORT_TOL / model.rows.total)
    minimum = LBFGS().minimise(model.objective(table), table.start(), table.limits(), n_iter, tolerance, monitor)
    values = table.values(minimum.x)
    each = range(len(values["noise"]))
    return [values | {name: values[name][[o]] for name in ("signal", "noise")} for o in each]
