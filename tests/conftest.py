"""One BLAS thread per worker, since tests run in as many processes as there are cores."""

import os
import signal
from importlib import import_module
from importlib.metadata import version

import pytest

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# A shell that starts the tests in the background lets them ignore Ctrl-C; those that send it would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)

# scikit-learn 1.6 takes no rows of a pyarrow table.
_SKLEARN = tuple(int(part) for part in version("scikit-learn").split(".")[:2])
_FRAMES = ["pandas.DataFrame", "polars.DataFrame"]
if _SKLEARN >= (1, 7):
    _FRAMES.append(pytest.param("pyarrow.table", marks=pytest.mark.long))


@pytest.fixture(params=_FRAMES)
def frame_of(request):
    """Make a data frame of named columns; of each package in turn."""
    package, name = request.param.split(".")
    return getattr(import_module(package), name)


def pytest_unconfigure(config):
    """Say in the last line how to run the rest."""
    if config.option.markexpr == "not long" and not hasattr(config, "workerinput"):
        rest = "pip install -e '.[physics,plot,dask,test-long]' && python -m pytest -n auto -m long"
        config.get_terminal_writer().line(f"These were the quick tests. The long ones: {rest}")
