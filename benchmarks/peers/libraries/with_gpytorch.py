"""GPyTorch as a peer, in double precision: SGPR with Adam on all rows, SVGP with Adam on mini-batches."""

from __future__ import annotations

from typing import Any

import numpy as np

from peers.jobs import Fitted, Fixed, Job, Predict, Said, Scaled, Watch

MODULES = ("gpytorch", "torch")
JITTER = "none, but 1e-8 and more where a Cholesky factorisation fails"


def covariance(kernel: str, lengthscales: np.ndarray, signal: float) -> Any:
    import gpytorch
    import torch

    d = len(lengthscales)
    shape = gpytorch.kernels.RBFKernel(ard_num_dims=d)
    if kernel == "matern52":
        shape = gpytorch.kernels.MaternKernel(nu=2.5, ard_num_dims=d)
    scaled = gpytorch.kernels.ScaleKernel(shape)
    scaled.outputscale = signal
    shape.lengthscale = torch.tensor(lengthscales)
    return scaled


def gaussian(noise: float) -> Any:
    import gpytorch

    # The default floor of 1e-4 is above the noise of dynamics.
    likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=gpytorch.constraints.GreaterThan(1e-6))
    likelihood.noise = noise
    return likelihood


def sgpr(X: Any, y: Any, Z: Any, kernel: Any, likelihood: Any) -> Any:
    import gpytorch

    class Collapsed(gpytorch.models.ExactGP):
        def __init__(self) -> None:
            super().__init__(X, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            self.covar_module = gpytorch.kernels.InducingPointKernel(kernel, Z.clone(), likelihood)

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    return Collapsed()


def svgp(Z: Any, kernel: Any) -> Any:
    import gpytorch

    class Variational(gpytorch.models.ApproximateGP):
        def __init__(self) -> None:
            q = gpytorch.variational.CholeskyVariationalDistribution(len(Z))
            super().__init__(gpytorch.variational.VariationalStrategy(self, Z.clone(), q))
            self.mean_module, self.covar_module = gpytorch.means.ZeroMean(), kernel

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    return Variational()


def _prediction(model: Any, likelihood: Any, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance with noise, of Titsias's posterior.

    Left to itself GPyTorch 1.15 has the exact diagonal of the prior covariance in test rows, which is right, and in
    training rows too, which makes it a FITC posterior: not that of the bound. What depends on training rows is cached
    at the first prediction, so that is made without.
    """
    import gpytorch
    import torch

    model.eval(), likelihood.eval()
    with torch.no_grad():
        if isinstance(model, gpytorch.models.ExactGP):
            with gpytorch.settings.sgpr_diagonal_correction(False):
                _ = model(torch.tensor(X[:1])).variance
        parts = [likelihood(model(torch.tensor(rows))) for rows in np.array_split(X, -(-len(X) // 1000))]
        mean, variance = (torch.cat([getattr(part, name) for part in parts]) for name in ("mean", "variance"))
    return mean.numpy(), variance.numpy()


def at_fixed(fixed: Fixed) -> Said:
    import gpytorch
    import torch

    torch.set_default_dtype(torch.float64)
    X, y, Z = (torch.tensor(array) for array in (fixed.X, fixed.y, fixed.inducing_points))
    likelihood = gaussian(fixed.noise)
    model = sgpr(X, y, Z, covariance(fixed.kernel, fixed.lengthscales, fixed.signal), likelihood)
    model.train(), likelihood.train()
    with torch.no_grad():
        bound = len(X) * gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)(model(X), y).item()
    return Said(bound, *_prediction(model, likelihood, fixed.X_test))


def fit(job: Job, watch: Watch, variational: bool) -> Fitted:
    """SGPR: 300 steps of 0.1 (0.01 of its tutorial gets nowhere in as many); SVGP: 3000 of 0.01 on 256 rows."""
    import gpytorch
    import torch

    torch.set_default_dtype(torch.float64)
    torch.manual_seed(job.seed)
    scaled = Scaled(job)
    X, Z = torch.tensor(scaled.X), torch.tensor(scaled.Z)
    learning_rate, n_steps, n_batch = (0.01, 3000, 256) if variational else (0.1, 300, len(X))
    ways, bounds, stops, n_done = [], [], [], 0
    for index, columns in enumerate(scaled.models):
        deadline, y, stop = watch.deadline(index), torch.tensor(scaled.Y[:, columns[0]]), "steps"
        kernel, likelihood = covariance("rbf", scaled.lengthscales, 1.0), gaussian(job.noise)
        if variational:
            model = svgp(Z, kernel)
            objective = gpytorch.mlls.VariationalELBO(likelihood, model, num_data=len(X))
            parameters = [*model.parameters(), *likelihood.parameters()]
        else:
            model = sgpr(X, y, Z, kernel, likelihood)
            objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
            parameters = list(model.parameters())
        whole = torch.nn.ModuleList([model, likelihood])
        whole.train()
        adam, best = torch.optim.Adam(parameters, lr=learning_rate), -np.inf
        steps = [(watch.seconds, _state(whole))]
        for _ in range(n_steps):
            if watch.seconds > deadline:
                stop = "time"
                break
            rows = torch.randint(len(X), (n_batch,)) if variational else slice(None)
            adam.zero_grad()
            loss = -objective(model(X[rows]), y[rows])
            loss.backward()
            bound = -len(X) * loss.item()
            if not variational:
                watch.record(index, scaled.bound(bound, columns))
                if bound > best:
                    best = bound
                    steps.append((watch.seconds, _state(whole)))
            adam.step()
            n_done += 1
        if variational:
            with torch.no_grad():
                best = len(X) * objective(model(X), y).item()
            watch.record(index, scaled.bound(best, columns))
            steps.append((watch.seconds, _state(whole)))
        bounds.append(scaled.bound(best, columns))
        stops.append(stop)
        ways.append([(seconds, _predict(whole, state)) for seconds, state in steps])
    said = {"bounds": bounds, "stop": " ".join(stops), "iterations": n_done, "evaluations": n_done}
    return scaled.fitted(ways, watch, **said)


def _state(whole: Any) -> dict[str, Any]:
    return {name: value.detach().clone() for name, value in whole.state_dict().items()}


def _predict(whole: Any, state: dict[str, Any]) -> Predict:
    def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # What was cached for predictions is forgotten by going through the training mode.
        whole.train()
        whole.load_state_dict(state)
        mean, variance = _prediction(*whole, X)
        return mean, np.sqrt(variance)

    return predict
