"""One BLAS thread per worker, since tests run in as many processes as there are cores."""

import os
import signal

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# A shell that starts the tests in the background lets them ignore Ctrl-C; those that send it would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)
