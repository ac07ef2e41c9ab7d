"""The tables and figures of the paper, computed here, on the systems and models of `models`.

The scales of its Table 1 are the defaults of `skevgp.datasets.make_dynamics`. The sizes of its Table 2 are in `models`.
``published.csv`` has the numbers of its Table 4.
"""
