"""The tables and figures of the paper, computed here, on the systems and models of `models`.

Its Table 1, of scales, is the defaults of `skevgp.datasets.make_dynamics`; its Table 2, of sizes, is in `models`.
``published.csv`` has the numbers of its Table 4.
"""
