"""A neural network whose weights are normal variables: its variational loss, the loss's gradient, its functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

# Inputs that are all 0 spread nothing; the square root must still have a slope there.
_TINY = 1e-32
# Bounds of log standard deviations, in units of the prior's, and of log noise variances, in units of the targets'.
_LOG_STD = (np.log(1e-9), np.log(1e3))
_LOG_NOISE = (np.log(1e-12), np.log(1e6))
# Weights start nearly certain: what the data do not fix spreads out later.
_FIRST_SHARE_OF_PRIOR = 0.01


@dataclass(frozen=True)
class Layer:
    """Weights (fan in, fan out) with means and log standard deviations, and biases (fan out,)."""

    mean: np.ndarray
    log_std: np.ndarray
    bias: np.ndarray


class VariationalNetwork:
    """LeakyReLU layers with weights w ~ N(mean, std²) independent of each other; the biases are numbers.

    Its parameters are one flat vector: means, log standard deviations, biases, and a log noise variance per output.

    Parameters
    ----------
    sizes : sequence of int
        Units of each layer, the inputs first and the outputs last.
    prior_scales : sequence of float
        Standard deviations of the weights' prior, one per layer of weights; its mean is 0.
    negative_slope : float
        Of LeakyReLU.
    """

    def __init__(self, sizes: Sequence[int], prior_scales: Sequence[float], negative_slope: float):
        self.sizes = tuple(sizes)
        shapes = list(pairwise(sizes))
        self._shapes = shapes
        self._weights = _slices([i * o for i, o in shapes])
        self._outs = _slices([o for _, o in shapes] + [sizes[-1]])
        self._slope = negative_slope
        self._prior_log_std = np.repeat(np.log(prior_scales), [i * o for i, o in shapes])
        self._prior_precision = np.exp(-2.0 * self._prior_log_std)

    @property
    def n_weights(self) -> int:
        return self._weights[-1].stop

    @property
    def n_parameters(self) -> int:
        """Mean and deviation of each weight, each bias, each output's noise."""
        return 2 * self.n_weights + self._outs[-1].stop

    @property
    def n_hidden(self) -> int:
        return self._outs[-2].start

    def split(self, vector: np.ndarray) -> tuple[list[Layer], np.ndarray]:
        """Views of a flat vector: the layers, and the log noise variances (o,)."""
        n = self.n_weights
        *biases, log_noise = (vector[2 * n :][part] for part in self._outs)
        means, log_stds = self._matrices(vector[:n]), self._matrices(vector[n : 2 * n])
        return [Layer(*parts) for parts in zip(means, log_stds, biases, strict=True)], log_noise

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the flat vector, far from anything sensible."""
        both = []
        for k in range(2):
            limit = np.full(self.n_parameters, (-np.inf, np.inf)[k])
            limit[self.n_weights : 2 * self.n_weights] = self._prior_log_std + _LOG_STD[k]
            self.split(limit)[1][:] = _LOG_NOISE[k]
            both.append(limit)
        return both[0], both[1]

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """Means as He et al. (2015) draw them, nearly certain; biases 0; targets that are all noise."""
        theta = np.zeros(self.n_parameters)
        layers, _ = self.split(theta)
        for layer in layers[:-1]:
            gain = np.sqrt(2.0 / (1.0 + self._slope**2))
            layer.mean[:] = gain / np.sqrt(len(layer.mean)) * rng.standard_normal(layer.mean.shape)
        layers[-1].mean[:] = rng.standard_normal(layers[-1].mean.shape) * 0.1 / np.sqrt(len(layers[-1].mean))
        theta[self.n_weights : 2 * self.n_weights] = self._prior_log_std + np.log(_FIRST_SHARE_OF_PRIOR)
        return theta

    def loss_and_gradient(
        self,
        theta: np.ndarray,
        X: np.ndarray,
        Y: np.ndarray,
        draws: np.ndarray,
        n_rows: float,
        weights: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray]:
        """Minus the evidence lower bound per row, in nats, as a mini-batch estimates it.

        Pre-activations are drawn instead of weights (Kingma, Salimans & Welling 2015, section 2.2), row by row; the
        last layer's are not even drawn, as the normal likelihood is integrated over them in closed form.

        Parameters
        ----------
        theta : ndarray of shape (n_parameters,)
        X, Y : ndarray of shape (b, d), (b, o)
        draws : ndarray of shape (b, n_hidden)
            Standard normal numbers.
        n_rows : float
            Of the whole training set, each as often as it counts.
        weights : ndarray of shape (b,), default=None
            How often each row counts, in units of their mean over the training set; None are ones.
        """
        n = self.n_weights
        gradient = np.empty_like(theta)
        (layers, log_noise), (slopes, noise_slope) = self.split(theta), self.split(gradient)
        flat_variances = np.exp(2.0 * theta[n : 2 * n])
        variances = self._matrices(flat_variances)
        forward = self._forward(layers, variances, X, draws)

        error, precision = Y - forward.mean, np.exp(-log_noise)
        misfit = _mean(error**2 + forward.variance, weights)
        divergence = 0.5 * (theta[:n] ** 2 + flat_variances) * self._prior_precision
        divergence += self._prior_log_std - theta[n : 2 * n] - 0.5
        loss = _log_loss(misfit, log_noise) + float(divergence.sum()) / n_rows

        noise_slope[:] = 0.5 - 0.5 * precision * misfit
        to_mean = error * (-precision / len(X))
        to_variance = np.broadcast_to(0.5 * precision / len(X), error.shape)
        if weights is not None:
            to_mean *= weights[:, np.newaxis]
            to_variance = to_variance * weights[:, np.newaxis]
        for k in reversed(range(len(layers))):
            np.matmul(forward.inputs[k].T, to_mean, out=slopes[k].mean)
            np.matmul(forward.squares[k].T, to_variance, out=slopes[k].log_std)
            to_mean.sum(axis=0, out=slopes[k].bias)
            if k > 0:
                to_mean = to_mean @ layers[k].mean.T + 2.0 * forward.inputs[k] * (to_variance @ variances[k].T)
                to_mean *= np.where(forward.inputs[k] > 0.0, 1.0, self._slope)
                to_variance = 0.5 * to_mean * forward.noises[k - 1] / forward.spreads[k - 1]
        gradient[:n] += theta[:n] * self._prior_precision / n_rows
        gradient[n : 2 * n] *= 2.0 * flat_variances
        gradient[n : 2 * n] += (flat_variances * self._prior_precision - 1.0) / n_rows
        return loss, gradient

    def expected_log_likelihood(
        self, theta: np.ndarray, X: np.ndarray, Y: np.ndarray, draws: np.ndarray, weights: np.ndarray | None = None
    ) -> float:
        """Per row, in nats; one draw of the hidden pre-activations of each row. The mean of the ``weights`` is 1."""
        layers, log_noise = self.split(theta)
        forward = self._forward(layers, [np.exp(2.0 * layer.log_std) for layer in layers], X, draws)
        return -_log_loss(_mean((Y - forward.mean) ** 2 + forward.variance, weights), log_noise)

    def draw(
        self, theta: np.ndarray, n_draws: int, rng: np.random.Generator, mirrored: bool = False
    ) -> list[np.ndarray]:
        """Weights (n_draws, fan in, fan out) of each layer.

        In pairs mirrored at their means, if asked for: what is odd in the deviations cancels, and the mean over a few
        draws is a good mean.
        """
        weights = []
        for layer in self.split(theta)[0]:
            deviations = rng.standard_normal(((n_draws + 1) // 2 if mirrored else n_draws, *layer.mean.shape))
            if mirrored:
                deviations = np.concatenate([deviations, -deviations])[:n_draws]
            weights.append(layer.mean + np.exp(layer.log_std) * deviations)
        return weights

    def functions(self, theta: np.ndarray, weights: list[np.ndarray], X: np.ndarray) -> np.ndarray:
        """Outputs (n_draws, b, o) at rows X (b, d), without noise, of each draw of the weights."""
        layers, _ = self.split(theta)
        outputs = X[np.newaxis]
        for k, (layer, drawn) in enumerate(zip(layers, weights, strict=True)):
            outputs = outputs @ drawn + layer.bias
            if k < len(layers) - 1:
                outputs = np.maximum(outputs, self._slope * outputs)
        return outputs

    def _matrices(self, flat: np.ndarray) -> list[np.ndarray]:
        return [flat[part].reshape(shape) for part, shape in zip(self._weights, self._shapes, strict=True)]

    def _forward(self, layers: list[Layer], variances: list[np.ndarray], X: np.ndarray, draws: np.ndarray) -> _Pass:
        inputs, squares, spreads = [X], [X**2], []
        noises = [draws[:, part] for part in self._outs[:-2]]
        for layer, variance, noise in zip(layers[:-1], variances[:-1], noises, strict=True):
            spreads.append(np.sqrt(squares[-1] @ variance + _TINY))
            values = inputs[-1] @ layer.mean + layer.bias + spreads[-1] * noise
            inputs.append(np.maximum(values, self._slope * values))
            squares.append(inputs[-1] ** 2)
        mean = inputs[-1] @ layers[-1].mean + layers[-1].bias
        return _Pass(inputs, squares, noises, spreads, mean, squares[-1] @ variances[-1])


@dataclass(frozen=True)
class _Pass:
    """Inputs of each layer and their squares; of the hidden layers the draws and standard deviations of the
    pre-activations; means and variances (b, o) of the outputs.
    """

    inputs: list[np.ndarray]
    squares: list[np.ndarray]
    noises: list[np.ndarray]
    spreads: list[np.ndarray]
    mean: np.ndarray
    variance: np.ndarray


def _slices(sizes: Sequence[int]) -> list[slice]:
    """Of parts that follow each other."""
    return [slice(*ends) for ends in pairwise(accumulate(sizes, initial=0))]


def _mean(values: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Over rows, with weights of mean 1."""
    return values.mean(axis=0) if weights is None else weights @ values / len(values)


def _log_loss(misfit: np.ndarray, log_noise: np.ndarray) -> float:
    """Minus the expected log density of a row, of mean squared errors and log noise variances (o,)."""
    return 0.5 * float((np.log(2.0 * np.pi) + log_noise + misfit * np.exp(-log_noise)).sum())
