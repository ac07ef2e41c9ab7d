"""
Calibrate a simulator
=====================

A simulator has parameters that nobody has measured, such as the length of a pole and its friction. Here a regressor
learns them from data, with intervals. A Gaussian process learns the residual of the simulator. The second part shows
the meaning of a parameter if the simulator is wrong.
"""

# %%
# Define the simulator
# --------------------
# The simulator is a function in autograd.numpy. It computes the change of a pendulum's angular velocity in 0.03 s, for
# rows of angle, velocity and torque. Its friction is viscous, and dry with a Stribeck effect: it is larger at low
# speed.

import autograd.numpy as np
import matplotlib.pyplot as plt
from sklearn.preprocessing import FunctionTransformer

from skevgp import CoefPrior, EVGPRegressor
from skevgp.features import LogNormal, Normal, ParametricFeatures

plt.style.use("skevgp.plotting.page")
STEP = 0.03  # s


def acceleration(q, v, u, length, damping, coulomb, stribeck_velocity):
    stribeck = 1.0 + 0.5 * np.exp(-((v / stribeck_velocity) ** 2))
    friction = damping * v + coulomb * stribeck * np.tanh(v / 0.1)
    return (u - friction - 9.81 * length * np.sin(q)) / length**2  # for a mass of 1 kg


def change(X, ripple=0.0, **theta):
    q, v, u = X[:, 0], X[:, 1], X[:, 2]
    u = u + ripple * np.sin(3.0 * q)
    middle = acceleration(q, v, u, **theta)
    return STEP * acceleration(q + 0.5 * STEP * v, v + 0.5 * STEP * middle, u, **theta)


# %%
# Simulate data
# -------------
# The real motor has a ripple, a torque that depends on the angle. The simulator does not include it.

true = {"length": 0.5, "damping": 0.1, "coulomb": 0.2, "stribeck_velocity": 0.5}
rng = np.random.default_rng(1)
X, X_test = (rng.uniform(-1.0, 1.0, (n, 3)) * [np.pi, 6.0, 4.0] for n in (400, 2000))
y, y_test = (change(rows, ripple=0.2, **true) for rows in (X, X_test))
y = y + 0.01 * np.std(y) * rng.standard_normal(len(y))

# %%
# Learn the parameters
# --------------------
# Each parameter has a prior. Here the medians are 20 % too large. ``CoefPrior(mean=1.0, scale=0.0)`` fixes the weight
# of the simulator at 1.

priors = {name: LogNormal(1.2 * value, 0.4) for name, value in true.items()}
units = {"length": "m", "damping": "N m s/rad", "coulomb": "N m", "stribeck_velocity": "rad/s"}
as_it_is = CoefPrior(mean=1.0, scale=0.0)
options = {"coef_prior": as_it_is, "n_inducing": 60, "random_state": 0}
learned = EVGPRegressor(ParametricFeatures(change, priors, units), **options).fit(X, y)
print(learned.summary())

# %%
# If the parameters stay 20 % wrong, the Gaussian process has to explain more:

off = {name: 1.2 * value for name, value in true.items()}
fixed = EVGPRegressor(FunctionTransformer(lambda X: change(X, **off).reshape(-1, 1)), **options).fit(X, y)
plain = EVGPRegressor(n_inducing=options["n_inducing"], random_state=0).fit(X, y)
models = {"learned": learned, "20 % off": fixed, "no simulator": plain}
errors = {name: np.sqrt(np.mean((model.predict(X_test) - y_test) ** 2)) for name, model in models.items()}
for name, error in errors.items():
    print(f"{name:14s} RMSE {error:.4f} rad/s")

# %%
# Calibrate a wrong simulator
# ---------------------------
# Plumlee (2017) simulates 4 x + x sin(5 x) by a line θ x. No θ is right. With ``discrepancy="free"``, the Gaussian
# process can follow the line too, so θ is very uncertain. With ``"orthogonal"``, θ is the best fit in least squares,
# which the data determine well. Predictions are the same.


def line(X, slope):
    return slope * X


x = np.linspace(0.0, 1.0, 50).reshape(-1, 1)
z = 4.0 * x[:, 0] + x[:, 0] * np.sin(5.0 * x[:, 0]) + 0.05 * rng.standard_normal(50)
lines = {}
for discrepancy in ("free", "orthogonal"):
    features = ParametricFeatures(line, {"slope": Normal(3.0, 1.0)})
    model = EVGPRegressor(features, discrepancy=discrepancy, coef_prior=as_it_is, random_state=0).fit(x, z)
    print(f"{discrepancy:10s} slope {model.theta_['slope']:.3f} ± {model.theta_std_['slope']:.3f}")
    lines[discrepancy] = model

# %%
# Plot the results
# ----------------

figure, ((of_theta, of_errors), (free, orthogonal)) = plt.subplots(2, 2, figsize=(8, 6.4))
for place, name in enumerate(true):
    prior, (value, std) = priors[name], (learned.theta_[name], learned.theta_std_[name])
    low, high = prior.value(-1.96) / true[name], prior.value(1.96) / true[name]
    of_theta.plot([low, high], [place, place], color="0.75", linewidth=6, label="prior" if place == 0 else None)
    reach = 1.96 * std / true[name]
    options = {"fmt": "o", "color": "#0072B2", "capsize": 3, "label": "posterior" if place == 0 else None}
    of_theta.errorbar(value / true[name], place, xerr=reach, **options)
of_theta.axvline(1.0, color="k", linewidth=1)
of_theta.set(yticks=range(len(true)), yticklabels=[name.replace("_", "\n") for name in true], xlim=(0.4, 2.7))
of_theta.set(xlabel="value / true value", title="Parameters, 95 % intervals")
of_theta.invert_yaxis()
of_theta.legend(loc="center right", bbox_to_anchor=(1.0, 0.83))
bars = of_errors.barh(list(errors), [1e3 * error for error in errors.values()], color=["#0072B2", "#D55E00", "0.6"])
of_errors.bar_label(bars, fmt="%.1f", padding=3)
of_errors.set(xlabel="RMSE on new rows (10⁻³ rad/s)", title="Errors of predictions")
of_errors.invert_yaxis()
for axes, (discrepancy, model) in zip((free, orthogonal), lines.items(), strict=True):
    grid = np.linspace(0.0, 1.0, 100)
    slope, std = model.theta_["slope"], model.theta_std_["slope"]
    axes.plot(x, z, ".", color="0.6", label="data")
    axes.plot(grid, 4.0 * grid + grid * np.sin(5.0 * grid), "k", linewidth=1, label="truth")
    axes.plot(grid, slope * grid, color="#D55E00", label="simulator")
    reach = 1.96 * std * grid
    axes.fill_between(grid, slope * grid - reach, slope * grid + reach, color="#D55E00", alpha=0.3, linewidth=0)
    axes.plot(grid, model.predict(grid.reshape(-1, 1)), color="#0072B2", linestyle="--", label="prediction")
    axes.set(xlabel="x", ylabel="y", title=f'discrepancy="{discrepancy}": θ = {slope:.2f} ± {1.96 * std:.2f}')
free.legend(loc="upper left")
plt.show()
