"""One evaluation of the bound and its gradient against the dense products that it cannot do without.

The floor is four products over all rows, `L_inv @ U`, `V @ V.T`, `G @ V` and `L_inv.T @ (G @ V)`, in NumPy in the same
process. Evaluation and floor take turns in rounds; medians are compared. Both use one core, or both use all: skevgp in
threads of its own, the floor in those of BLAS.

    python benchmarks/speed/evaluation_cost.py          # the sizes of the data sets, and sweeps over rows and points
    python benchmarks/speed/evaluation_cost.py --quick  # a few small sizes
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from threadpoolctl import threadpool_limits

import harness
import skevgp
from internals import evaluation

# Rows, inducing points, columns, outputs: of the pendulum, the cartpole, the acrobot, the IIWA.
NAMED = {
    "pendulum": (4800, 10, 3, 2),
    "cartpole": (4800, 100, 5, 4),
    "acrobot": (9300, 150, 5, 4),
    "iiwa14": (23250, 350, 21, 14),
}
ROWS = [(n, 100, 5, 4) for n in (1000, 3000, 10_000, 30_000, 100_000)]
POINTS = [(9300, m, 5, 4) for m in (10, 25, 50, 100, 200, 400)]
QUICK = {"data": {"pendulum": NAMED["pendulum"]}, "rows": [(1000, 20, 3, 2)], "points": [(1000, 10, 3, 2)]}
COLUMNS = ["sweep", "name", "n", "m", "d", "outputs", "cores", "evaluation_ms", "floor_ms", "ratio"]
COLUMNS += ["evaluation_fastest_ms", "floor_fastest_ms", "repeats", "versions", "machine"]


def products(n: int, m: int) -> Callable[[], object]:
    """The floor: four dense products on all rows."""
    rng = np.random.RandomState(0)
    L_inv, U, G = np.tril(rng.randn(m, m)), rng.rand(m, n), rng.randn(m, m)

    def floor() -> object:
        V = L_inv @ U
        return V @ V.T, L_inv.T @ (G @ V)

    return floor


def measure(n: int, m: int, d: int, n_outputs: int, cores: int, repeats: int) -> np.ndarray:
    """Medians (first row) and fastest of the evaluation and the floor, in milliseconds.

    They take turns in four rounds of several, with a pause between: BLAS's threads wait for more work for a while after
    a product, and would take the cores from the evaluation's.
    """
    floor, per_round = products(n, m), -(-repeats // 4)
    seconds: tuple[list[float], list[float]] = ([], [])
    with evaluation(n, m, d, n_outputs, cores) as evaluate:
        for _ in range(4):
            # In a fit BLAS has one thread: what runs on several cores is skevgp's own.
            for own, run, n_threads in ((seconds[0], evaluate, 1), (seconds[1], floor, cores)):
                time.sleep(0.2)
                with threadpool_limits(n_threads):
                    run()
                    for _ in range(per_round):
                        begin = time.perf_counter()
                        run()
                        own.append(time.perf_counter() - begin)
    return 1e3 * np.array([np.median(seconds, axis=1), np.min(seconds, axis=1)])


def _first(rows: list[dict[str, str]], sweep: str) -> dict[str, str]:
    return next(row for row in rows if row["sweep"] == sweep)


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """The ratio over rows and over inducing points, and for the data sets; the aim of 2 as a line."""
    from matplotlib.ticker import FixedLocator

    figure, axes = harness.pyplot().subplots(1, 3, figsize=(harness.WIDTH, 3.0), sharey=True)
    styles = tuple(zip(harness.PALETTE, "os^", ("-", "--", ":"), strict=False))
    for cores, (colour, marker, line) in zip(sorted({int(row["cores"]) for row in rows}), styles, strict=False):
        label = "1 core" if cores == 1 else f"{cores} cores"
        for ax, sweep, column in ((axes[0], "rows", "n"), (axes[1], "points", "m"), (axes[2], "data", "name")):
            own = [row for row in rows if row["sweep"] == sweep and int(row["cores"]) == cores]
            x = [row["name"] if column == "name" else int(row[column]) for row in own]
            ratio = [float(row["ratio"]) for row in own]
            ax.plot(x, ratio, marker, linestyle="" if column == "name" else line, color=colour, label=label)
    for ax, title, xlabel in (
        (axes[0], "{m} inducing points, {outputs} outputs".format(**_first(rows, "rows")), "rows"),
        (axes[1], "{n} rows, {outputs} outputs".format(**_first(rows, "points")), "inducing points"),
        (axes[2], "sizes of the data sets", ""),
    ):
        ax.axhline(2.0, color="#555555", linewidth=1, linestyle=":")
        ax.set(title=title, xlabel=xlabel)
    for ax in axes[:2]:
        harness.logarithmic(ax, "x")
    axes[2].margins(x=0.15)
    harness.logarithmic(axes[0])
    axes[0].yaxis.set_major_locator(FixedLocator([1, 2, 5, 10, 20, 50, 100]))
    axes[0].set_ylabel("time / time of the dense products")
    axes[0].legend()
    axes[2].text(
        1.0, 2.02, "aim: 2×", color="#555555", transform=axes[2].get_yaxis_transform(), va="bottom", ha="right"
    )
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="a few small sizes", in_processes=False)
    parser.add_argument("--repeats", type=int, default=20, help="default: %(default)s")
    parser.add_argument("--cores", type=int, nargs="+", default=sorted({1, os.cpu_count() or 1}))
    options = parser.parse_args()
    output = harness.output_path(options, "evaluation_cost")

    sweeps = QUICK if options.quick else {"data": NAMED, "rows": ROWS, "points": POINTS}
    sizes = [("data", name, size) for name, size in sweeps["data"].items()]
    sizes += [(sweep, "", size) for sweep in ("rows", "points") for size in sweeps[sweep]]
    versions = f"skevgp {skevgp.__version__} numpy {np.__version__}"
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    rows = []
    titles = ("", "rows", "points", "columns", "outputs", "cores", "ms", "floor", "ratio", "of fastest")
    print("".join(f"{title:>11s}" for title in titles))
    for sweep, name, size in sizes:
        for cores in options.cores:
            median, fastest = measure(*size, cores, options.repeats)
            ratio, of_fastest = (times[0] / times[1] for times in (median, fastest))
            values = (sweep, name, *size, cores, *median, ratio, *fastest, options.repeats, versions, machine)
            rows.append(dict(zip(COLUMNS, map(str, values), strict=True)))
            numbers = "".join(f"{value:11d}" for value in (*size, cores))
            print(f"{name:>11s}{numbers}{median[0]:11.2f}{median[1]:11.2f}{ratio:11.2f}{of_fastest:11.2f}", flush=True)
            harness.write(rows, COLUMNS, output)
    draw(rows, output.with_suffix(".png"))


if __name__ == "__main__":
    main()
