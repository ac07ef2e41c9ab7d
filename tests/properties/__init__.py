"""What must be true of any data and any model: hypothesis looks for an example of which it is not.

In CI few examples are tried, the same at each run. New ones, a thousand of each property, in a run of hours:

    SKEVGP_EXAMPLES=1000 pytest tests/properties

A failure ends with `@reproduce_failure(...)`: this line above the test tries that example again.
"""
