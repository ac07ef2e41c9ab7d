"""optuna searches over our parameters, by a score that sees the std."""

import pytest
from sklearn.model_selection import cross_val_score

from skevgp import EVGPRegressor
from skevgp.metrics import negative_log_predictive_density

optuna = pytest.importorskip("optuna")


def log_density(model, X, y):
    return -negative_log_predictive_density(y, *model.predict(X, return_std=True))


def test_a_study_finds_that_five_inducing_points_are_too_few(data):
    X, y = data

    def objective(trial):
        model = EVGPRegressor(
            n_inducing=trial.suggest_int("n_inducing", 5, 40),
            normalize_y=trial.suggest_categorical("normalize_y", [False, True]),
            random_state=0,
        )
        return cross_val_score(model, X, y, cv=3, scoring=log_density).mean()

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.RandomSampler(seed=0))
    study.enqueue_trial({"n_inducing": 5, "normalize_y": False})
    study.optimize(objective, n_trials=6)
    assert study.best_params["n_inducing"] > 5
    # The density of noise of 0.1 about the truth is exp(0.88).
    assert study.trials[0].value < study.best_value
    assert 0.6 < study.best_value < 1.0
    best = EVGPRegressor(**study.best_params, random_state=0).fit(X, y)
    assert best.score(X, y) > 0.95
