"""Summary of a fitted model as text, HTML and a data frame: kernel, noise, bounds and weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process.kernels import ConstantKernel, Product

from ..fitting.prior import coef_names
from ..fitting.theta import ThetaPosterior
from ..utils.optional import require

# Inputs of the Gaussian process of a joint's torque.
_OF_A_JOINT = ("q", "q̇", "q̈", "torque")
# Maximum number of lines of weights, and of columns of text.
_LINES, _WIDTH = 40, 100
# Maximum number of lines of a fact, such as a kernel of many columns.
_FACT_LINES = 6
# In percent: a smaller gain from the local part is not shown.
_LITTLE = 5
_CELL = 'style="text-align: left; padding: 0 1em 0 0"'
_TABLE = 'style="margin: 0.3em 0 1em 0; font-size: inherit"'
_SCROLLED = 'style="max-height: 30em; max-width: fit-content; overflow: auto"'


class Parameter(NamedTuple):
    """A learned number."""

    output: int | str | None  # None if it belongs to all outputs
    part: str  # "weight", "parameter" of the feature map, "signal std", "noise std", or a name such as "length_scale"
    name: str  # of the feature, or of the column of the kernel
    value: float
    std: float = np.nan  # posterior standard deviation of weights
    prior_mean: float = np.nan  # of weights
    prior_std: float = np.nan  # of weights
    # Ends of the 95 % credible interval, and of that of the prior. Only of parameters of the feature map.
    low: float = np.nan
    high: float = np.nan
    prior_low: float = np.nan
    prior_high: float = np.nan


@dataclass(frozen=True)
class ModelSummary:
    """Summary of a fitted model, as returned by its ``summary``.

    ``print`` shows it as text, and a notebook as tables.

    Attributes
    ----------
    title : str
        Name and size of the model.
    certificate : str
        Text on the log marginal likelihood, or empty.
    kernels : dict
        Fitted kernel of each output as text. The key is None if there is one output.
    parameters : tuple of Parameter
        All numbers, in the order of the text.
    lower_bound, upper_bound : float or None
        Bounds on the log marginal likelihood, in nats, which are equal for an exact model. None if they are not known.
    advice : str
        Text on what ``n_neighbors`` would gain, or on few rows, or empty.

    Examples
    --------
    >>> from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    >>> from sklearn.preprocessing import PolynomialFeatures
    >>> from skevgp import CoefPrior, EGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> kernel = ConstantKernel(25.0) * RBF(0.6) + WhiteKernel(2.8)
    >>> prior = CoefPrior(scale=[[2.0, 5.0]])
    >>> model = EGPRegressor(PolynomialFeatures(1), kernel, coef_prior=prior, max_iter=0).fit(X, y)
    >>> print(model.summary())
    EGPRegressor, exact, for 1 output
    log marginal likelihood: -410.85 nats
    <BLANKLINE>
    kernel        5**2 * RBF(length_scale=0.6)
    signal std    5
    length_scale  x0 0.6
    noise std     1.673
    <BLANKLINE>
    weight  prior  posterior
    1       0 ± 2  -0.7097 ± 1.8
    x0      0 ± 5  2.828 ± 0.73
    """

    title: str
    certificate: str
    kernels: dict[int | str | None, str]
    parameters: tuple[Parameter, ...]
    lower_bound: float | None = None
    upper_bound: float | None = None
    advice: str = ""

    def to_frame(self) -> Any:
        """Return all numbers as a pandas.DataFrame.

        Returns
        -------
        frame : pandas.DataFrame
            A row for each number, with the columns of `Parameter`: for example ``frame[frame.part == "weight"]``.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        pandas = require("pandas", "A data frame")
        return pandas.DataFrame([list(one) for one in self.parameters], columns=list(Parameter._fields))

    def __str__(self) -> str:
        """Return the text, with the first lines of weights if there are many."""
        parts = ["\n".join(filter(None, [self.title, self.certificate, self.advice]))]
        for output, facts in self._facts():
            width = max(map(len, facts)) + 2
            lines = [] if output is None else [f"output {output}"]
            for name, text in facts.items():
                wrapped = wrap(text, _WIDTH - width, break_long_words=False, break_on_hyphens=False)
                if len(wrapped) > _FACT_LINES + 1:
                    wrapped[_FACT_LINES:] = [f"... and {len(wrapped) - _FACT_LINES} more lines: to_frame() has all"]
                labels = [name, *[""] * (len(wrapped) - 1)]
                lines += [f"{label:{width}}{line}" for label, line in zip(labels, wrapped, strict=True)]
            parts.append("\n".join(lines))
        for rows in (self._of_feature_map(), self._weights()):
            # The name of a column may contain a line end.
            table = [[" ".join(cell.split()) for cell in row] for row in rows]
            if len(table) == 1:
                continue
            shown = table[: _LINES + 1]
            widths = [max(len(line[column]) for line in shown) for column in range(len(table[0]))]
            lines = [
                "  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)).rstrip()
                for line in shown
            ]
            if len(table) > len(shown):
                lines.append(f"... and {len(table) - len(shown)} more: to_frame() has all")
            parts.append("\n".join(lines))
        return "\n\n".join(parts)

    def _repr_html_(self) -> str:
        """Return tables, with all names escaped."""
        lines = "".join(f"<br>{escape(line)}" for line in (self.certificate, self.advice) if line)
        parts = [f"<p><b>{escape(self.title)}</b>{lines}</p>"]
        for output, facts in self._facts():
            parts.append("" if output is None else f"<p>output <b>{escape(str(output))}</b></p>")
            parts.append(html_table(list(facts.items())))
        for table in (list(self._of_feature_map()), list(self._weights())):
            if len(table) == 1:
                continue
            parts.append(f"<div {_SCROLLED}>{html_table(table[1:], table[0])}</div>")
        return f'<div style="font-size: 0.9em">{"".join(parts)}</div>'

    def _facts(self) -> Iterator[tuple[int | str | None, dict[str, str]]]:
        """Yield each output with its numbers other than weights: name -> text."""
        others = [one for one in self.parameters if one.part not in ("weight", "parameter")]
        outputs = [*self.kernels, *(one.output for one in others)]
        for output in dict.fromkeys(outputs):
            facts = {"kernel": self.kernels[output]} if output in self.kernels else {}
            for one in others:
                if one.output == output:
                    said = _plus_minus(one.value, one.std)
                    text = f"{one.name} {said}" if one.name else said
                    facts[one.part] = f"{facts[one.part]}, {text}" if one.part in facts else text
            yield output, facts

    def _of_feature_map(self) -> Iterator[tuple[str, ...]]:
        """Yield the rows of the table of θ, the header first."""
        yield "parameter", "prior", "posterior", "95 % interval"
        for one in self.parameters:
            if one.part == "parameter":
                prior, interval = f"{one.prior_low:.4g} to {one.prior_high:.4g}", f"{one.low:.4g} to {one.high:.4g}"
                yield one.name, prior, _plus_minus(one.value, one.std), interval

    def _weights(self) -> Iterator[tuple[str, ...]]:
        """Yield the rows of the table of β, the header first."""
        weights = [one for one in self.parameters if one.part == "weight"]
        several = any(one.output is not None for one in weights)
        first = ("output",) if several else ()
        yield *first, "weight", "prior", "posterior"
        for one in weights:
            first = (str(one.output),) if several else ()
            yield *first, one.name, _plus_minus(one.prior_mean, one.prior_std), _plus_minus(one.value, one.std)


def html_of(model: Any) -> str:
    """Return the summary of a fitted model for notebooks, folded; empty before a fit."""
    try:
        said = model.summary()._repr_html_()
    except NotFittedError:
        return ""
    return f"<details open><summary>What was learned</summary>{said}</details>"


def of_gaussian_process(model: Any) -> ModelSummary:
    """Summarise a fitted `EVGPRegressor` or `EGPRegressor`."""
    several = isinstance(model.kernel_, list)
    kernels = dict(enumerate(model.kernel_)) if several else {None: model.kernel_}
    noise = np.atleast_1d(model.noise_variance_)
    columns = _kernel_columns(model)
    numbers: list[Parameter] = []
    for (output, kernel), variance in zip(kernels.items(), noise, strict=True):
        numbers += _of_kernel(kernel, output, columns)
        numbers.append(Parameter(output, "noise std", "", float(np.sqrt(variance))))
    if model._theta is not None:
        numbers += _of_theta(model._theta)
    if hasattr(model, "coef_"):
        outputs = list(range(len(model.coef_))) if model.coef_.ndim == 2 else [None]
        numbers += _of_weights(model, outputs)
    points = getattr(model, "inducing_points_", None)
    lower, upper = (getattr(model, name, None) for name in ("lower_bound_", "upper_bound_"))
    size = "exact"
    if points is None:
        lower = upper = model.log_marginal_likelihood_value_
    else:
        counts = {len(own) for own in points} if isinstance(points, list) else {points.shape[-2]}
        size = f"{' to '.join(dict.fromkeys(map(str, (min(counts), max(counts)))))} inducing points"
    near = model._posterior.predictor.groups[0].near
    certificate = _certificate(lower, upper)
    if near is not None:
        size += f" and {near.n_neighbors} neighbours"
        certificate = f"log likelihood of the approximation: {lower:.2f} nats"
    outputs_text = f"{len(noise)} output{'s' if len(noise) > 1 else ''}"
    return ModelSummary(
        f"{type(model).__name__}, {size}, for {outputs_text}",
        certificate,
        {output: str(kernel) for output, kernel in kernels.items()},
        tuple(numbers),
        lower,
        upper,
        _advice(model),
    )


def of_inverse_dynamics(model: Any, joints: Sequence[str]) -> ModelSummary:
    """Summarise a fitted `InverseDynamics`: weights of all joints, and the kernel and noise of each."""
    numbers: list[Parameter] = []
    kernels: dict[int | str | None, str] = {}
    for index, joint in enumerate(joints):
        residual = model.residual_models_[index]
        if residual is not None:
            kernels[joint] = str(residual.kernel_)
            columns = _OF_A_JOINT if model._has_robot else _kernel_columns(residual)
            numbers += _of_kernel(residual.kernel_, joint, columns)
            numbers.append(Parameter(joint, "share", "", float(model.residual_share_[index])))
        numbers.append(Parameter(joint, "noise std", "", float(np.sqrt(model.noise_variance_[index]))))
        if model.standing_std_[index] > 0.0:
            numbers.append(Parameter(joint, "at rest", "", float(model.standing_std_[index])))
        if model.gains_std_[index] > 0.0:
            numbers.append(Parameter(joint, "gain", "", float(model.gains_[index]), float(model.gains_std_[index])))
    if model._theta is not None:
        numbers += _of_theta(model._theta)
    outputs_text = f"{len(joints)} output{'s' if len(joints) > 1 else ''}"
    return ModelSummary(
        f"{type(model).__name__}, {len(model.coef_)} weights, for {outputs_text}",
        "",
        kernels,
        (*numbers, *_of_weights(model, [None])),
    )


def _of_theta(posterior: ThetaPosterior) -> Iterator[Parameter]:
    values, std, _ = posterior.attributes()
    q, intervals = len(values), posterior.intervals()
    before = ThetaPosterior(posterior.theta, np.zeros(q), np.eye(q)).intervals()
    for name, unit in zip(values, posterior.theta.units, strict=True):
        label = f"{name} [{unit}]" if unit else name
        yield Parameter(
            None, "parameter", label, values[name], std[name], np.nan, np.nan, *intervals[name], *before[name]
        )


def _of_weights(model: Any, outputs: Sequence[int | None]) -> Iterator[Parameter]:
    attributes = (model.coef_, model.coef_std_, model.coef_prior_mean_, model.coef_prior_scale_)
    tables = [np.atleast_2d(values) for values in attributes]
    for output, *rows in zip(outputs, *tables, strict=True):
        for name, *numbers in zip(model.coef_names_, *rows, strict=True):
            yield Parameter(output, "weight", str(name), *map(float, numbers))


def _kernel_columns(model: Any) -> Sequence[str]:
    """Return the names of the kernel's inputs."""
    columns = getattr(model, "feature_names_in_", None)
    if model.kernel_map_ is not None:
        return list(coef_names(model.kernel_map_, columns, model._posterior.maps.shapes[0][-1], "k"))
    return [f"x{index}" for index in range(model.n_features_in_)] if columns is None else list(columns)


def _of_kernel(kernel: Any, output: int | str | None, columns: Sequence[str]) -> Iterator[Parameter]:
    """Yield the hyperparameters of a kernel with their columns; the outermost constant as a standard deviation."""
    if isinstance(kernel, Product) and isinstance(kernel.k1, ConstantKernel):
        yield Parameter(output, "signal std", "", float(np.sqrt(kernel.k1.constant_value)))
        kernel = kernel.k2
    given = kernel.get_params()
    short = [one.name.rpartition("__")[2] for one in kernel.hyperparameters]
    for one, last in zip(kernel.hyperparameters, short, strict=True):
        values = np.atleast_1d(given[one.name])
        part = last if short.count(last) == 1 else one.name.replace("__", ".")
        for name, value in zip(columns if len(values) == len(columns) else [""] * len(values), values, strict=True):
            yield Parameter(output, part, str(name), float(value))


def _certificate(lower: Any, upper: Any) -> str:
    if lower == upper:
        return f"log marginal likelihood: {lower:.2f} nats"
    if np.isinf(upper):
        return f"log marginal likelihood: at least {lower:.2f} nats"
    return f"log marginal likelihood: from {lower:.2f} to {upper:.2f} nats"


def _advice(model: Any) -> str:
    """Text on the share of the error that a local part would take away, or on few rows."""
    gain, few, n_draws = model._gain_of_neighbours, model._fitted.few, model._fitted.n_draws
    if gain is not None and 100.0 * gain >= _LITTLE:
        return f"n_neighbors=60 would lower the error by at least about {100.0 * gain:.0f} %"
    if few is None:
        return ""
    n_rows, n_numbers = few
    then = f"predictions are averaged over {n_draws} draws of these" if n_draws else "std may be too small"
    said = f"{n_rows} rows are few for {n_numbers} numbers of kernel and noise: {then}"
    if n_numbers < n_rows or len(_kernel_columns(model)) < 2:
        return said
    return f"{said}. A kernel with one length scale, such as RBF(1.0), or fewer columns may predict better"


def _plus_minus(value: float, std: float) -> str:
    """Format a number, with its standard deviation to two digits if that is known."""
    return f"{value:.4g}" if np.isnan(std) else f"{value:.4g} ± {std:.2g}"


def html_table(lines: Sequence[Sequence[str]], header: Sequence[str] = ()) -> str:
    head = "".join(f"<th {_CELL}>{escape(cell)}</th>" for cell in header)
    rows = "".join(f"<tr>{''.join(f'<td {_CELL}>{escape(cell)}</td>' for cell in line)}</tr>" for line in lines)
    return f"<table {_TABLE}>{f'<thead><tr>{head}</tr></thead>' if header else ''}<tbody>{rows}</tbody></table>"
