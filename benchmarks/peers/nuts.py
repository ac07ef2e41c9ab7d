"""The exact Gaussian process with the prior of skevgp for few rows, by the No-U-Turn sampler of NumPyro.

    ~/numpyro/bin/python benchmarks/peers/nuts.py given.npz found.npz

It reads X, y and X_test, and writes the mean and the std of the predictions, averaged over draws. `few_rows.py` calls
it. It needs numpyro, and nothing of skevgp.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist
from numpyro.infer import MCMC, NUTS

N_WARM_UP, N_DRAWS, N_USED, JITTER = 1000, 1000, 100, 1e-8


def kernel(A, B, length, signal):
    """Return the RBF kernel with one length scale for each column."""
    A, B = A / length, B / length
    squares = (A**2).sum(1)[:, None] + (B**2).sum(1)[None] - 2.0 * A @ B.T
    return signal * jnp.exp(-0.5 * jnp.clip(squares, 0.0))


def model(X, y):
    """The same priors as skevgp (docs/guide/few_rows.md)."""
    n, d = X.shape
    length = numpyro.sample("length", dist.LogNormal(jnp.full(d, 2.3 + 0.5 * np.log(d)), 1.4))
    signal = numpyro.sample("signal", dist.LogNormal(0.0, 4.0))
    noise = numpyro.sample("noise", dist.LogNormal(np.log(0.1), 2.0))
    K = kernel(X, X, length, signal) + (noise + JITTER * signal) * jnp.eye(n)
    numpyro.sample("y", dist.MultivariateNormal(jnp.zeros(n), K), obs=y)


def main() -> None:
    """Read rows, sample, and write predictions."""
    numpyro.enable_x64()
    with np.load(sys.argv[1]) as given:
        X, y, X_test = given["X"], given["y"], given["X_test"]
    mean, size = y.mean(), y.std()
    sampler = MCMC(NUTS(model), num_warmup=N_WARM_UP, num_samples=N_DRAWS, progress_bar=False)
    sampler.run(jax.random.PRNGKey(0), jnp.array((X - X.mean(0)) / X.std(0)), jnp.array((y - mean) / size))
    draws = sampler.get_samples()
    A, B = (X - X.mean(0)) / X.std(0), (X_test - X.mean(0)) / X.std(0)
    means, variances = [], []
    for i in np.linspace(0, N_DRAWS - 1, N_USED).astype(int):
        length, signal, noise = (draws[name][i] for name in ("length", "signal", "noise"))
        K = np.asarray(kernel(A, A, length, signal)) + (noise + JITTER * signal) * np.eye(len(A))
        across = np.asarray(kernel(A, B, length, signal))
        V = np.linalg.solve(np.linalg.cholesky(K), across)
        means.append(across.T @ np.linalg.solve(K, (y - mean) / size))
        variances.append(signal - (V**2).sum(0) + noise)
    average = np.mean(means, axis=0)
    variance = np.mean(variances, axis=0) + np.var(means, axis=0)
    np.savez(sys.argv[2], mean=mean + size * average, std=size * np.sqrt(np.maximum(variance, 1e-12)))


if __name__ == "__main__":
    main()
