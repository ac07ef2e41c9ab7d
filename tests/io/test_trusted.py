from importlib import import_module

import numpy as np
import pytest
import skops.io

from skevgp.io import TRUSTED_TYPES
from skevgp.kernels import FunctionKernel

from .models import CASES, X, Y, evgp, fitted, new_rows, predictions

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.mark.parametrize("name", CASES)
def test_skops_needs_to_trust_no_others(name):
    file = skops.io.dumps(fitted(name))
    assert set(skops.io.get_untrusted_types(data=file)) <= set(TRUSTED_TYPES)
    loaded = skops.io.loads(file, trusted=TRUSTED_TYPES)
    for found, expected in zip(
        predictions(loaded, new_rows(name)), predictions(fitted(name), new_rows(name)), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


# Which some versions of their packages do not have.
OF_VERSIONS = {
    "scipy._lib.array_api_compat.numpy._aliases.asarray",
    "scipy.interpolate._bsplines._BSpline",
    "sklearn.compose._column_transformer._RemainderColsList",
}


@pytest.mark.parametrize("name", sorted(set(TRUSTED_TYPES) - OF_VERSIONS))
def test_each_type_is_there(name):
    module, _, own = name.rpartition(".")
    assert getattr(import_module(module), own) is not None


def kernel(X, Z, size=1.0):
    return size * (X @ Z.T) ** 2


def test_functions_of_users_are_not_trusted():
    model = evgp(kernel=FunctionKernel(kernel)).fit(X, Y[:, 0])
    file = skops.io.dumps(model)
    assert "tests.io.test_trusted.kernel" in set(skops.io.get_untrusted_types(data=file)) - set(TRUSTED_TYPES)
    with pytest.raises(TypeError, match="Untrusted types"):
        skops.io.loads(file, trusted=TRUSTED_TYPES)
