"""What goes wrong around a fit reaches the user whole, and leaves the estimator as it was."""

import subprocess
import sys
import traceback
from threading import current_thread, main_thread

import autograd.numpy as anp
import numpy as np
import pytest
from sklearn.exceptions import NotFittedError

from skevgp import EVGPRegressor
from skevgp.kernels import FunctionKernel

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (3000, 2))
Y = np.column_stack([np.sin(X[:, 0]), X[:, 0] * X[:, 1]])


class OwnError(RuntimeError):
    def __init__(self, what, where):
        super().__init__(f"{what} at {where}")
        self.where = where


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_error_in_a_thread_is_the_users_own(n_jobs):
    def failing(X, Z, size=1.0):
        if n_jobs == 1 or current_thread() is not main_thread():
            raise OwnError("no kernel", 17)
        return anp.exp(-anp.sum((X[:, None] - Z[None]) ** 2, axis=2) / size**2)

    kernel = FunctionKernel(failing)
    model = EVGPRegressor(kernel=kernel, n_inducing=10, sharing="none", n_jobs=n_jobs, max_iter=5, random_state=0)
    with pytest.raises(OwnError, match="^no kernel at 17$") as caught:
        model.fit(X, Y)
    assert caught.value.where == 17
    assert "failing" in {frame.name for frame in traceback.extract_tb(caught.tb)}
    with pytest.raises(NotFittedError):
        model.predict(X)


MEMORY = """
import resource
import numpy as np
from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS

X = np.random.RandomState(0).uniform(size=(6000, 2))
y = np.sin(9.0 * X[:, 0])
model = EVGPRegressor(n_inducing=20, max_iter=2, solver=LBFGS(tol=1e9), random_state=0).fit(X, y)
before, known = model.predict(X[:50]), dict(vars(model))
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + 2**26, size + 2**26))
try:
    model.set_params(n_inducing=3000).fit(X, y)
except MemoryError as error:
    print("MemoryError", len(str(error)) > 0)
model.set_params(n_inducing=20)
print(all(vars(model)[name] is value for name, value in known.items()), (model.predict(X[:50]) == before).all())
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="RLIMIT_AS")
def test_memory_error_keeps_model():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", MEMORY], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["MemoryError True", "True True"], done.stderr
