"""The tables and figures of the paper, run here, on the systems and models of `models`.

`complexity` is its Table 3, `results_table` its Table 4 (`cartpole` a closer look at some of its lines), `toy` its
Figure 5, `learning_curves` its Figure 6, `beta` its Figure 7. Scales and sizes, its Tables 1 and 2, are the defaults of
`skevgp.datasets.make_dynamics` and in `models`.
"""
