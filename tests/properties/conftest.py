"""How many examples hypothesis tries, and which (tests/properties/__init__.py)."""

import os

from hypothesis import HealthCheck, settings

_MANY = os.environ.get("SKEVGP_EXAMPLES")
# Before the tests are read, which take fractions of the number.
settings.register_profile(
    "skevgp",
    max_examples=int(_MANY or 6),
    derandomize=_MANY is None,
    database=None,
    deadline=None,
    print_blob=True,
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("skevgp")
