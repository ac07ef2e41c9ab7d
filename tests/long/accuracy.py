"""Relative errors against 120 digits by mpmath, for each signal-to-noise ratio and condition of k(X_m, X_m).

A table in Markdown: for each figure the largest error of all problems, and in brackets, of the same problems, the
largest error of exact arithmetic with inputs that are off by a unit in the last place of doubles, and with values of
the kernel that are so too. The mean is relative to the largest |y|, the gradient to its largest entry, the variance
to that of a new y.

    python -m tests.long.accuracy --problems 6 --out accuracy.md
"""

import argparse
import time
import warnings
from collections import defaultdict
from pathlib import Path

import mpmath

from tests.accuracy import MODELS, Problem, errors
from tests.precise import DIGITS

RATIOS, CONDITIONS = (1.0, 1e4, 1e8, 1e10), (1e2, 1e6, 1e8, 1e10, 1e13, 1e16)
FIGURES = ("bound", "gradient", "mean", "variance", "latent variance")
# Of rows, inducing points, columns and features, in turn.
SHAPES = ((20, 8, 2, 2), (30, 12, 3, 3), (14, 6, 1, 0), (24, 10, 2, 1), (40, 18, 3, 0), (12, 5, 1, 2))


def run(n_problems, ratios=RATIOS, conditions=CONDITIONS, draws=1):
    """(model, ratio, condition) -> figure -> the largest (library, inputs, kernel), of problems of each shape."""
    found = defaultdict(dict)
    for ratio in ratios:
        for wanted in conditions:
            for seed in range(n_problems):
                n, m, d, p = SHAPES[seed % len(SHAPES)]
                problem = Problem.drawn(ratio, wanted, n, m, d, p, seed)
                for name, model in MODELS.items():
                    each = errors(model(problem), gradient=m <= 8, draws=draws)
                    largest = found[name, ratio, wanted]
                    for figure in each[0]:
                        own = tuple(one[figure] for one in each)
                        largest[figure] = tuple(map(max, own, largest.get(figure, own)))
    return found


def table(found):
    """In Markdown, one for each model."""
    lines = []
    for name in MODELS:
        lines += [f"## {name}", "", f"| signal to noise | condition | {' | '.join(FIGURES)} |"]
        lines.append("|---|---|" + "---|" * len(FIGURES))
        for (model, ratio, wanted), largest in found.items():
            if model == name:
                cells = ("{:.0e} ({:.0e}, {:.0e})".format(*largest[f]) if f in largest else "" for f in FIGURES)
                lines.append(f"| {ratio:.0e} | {wanted:.0e} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=4)
    parser.add_argument("--ratios", type=float, nargs="+", default=RATIOS)
    parser.add_argument("--conditions", type=float, nargs="+", default=CONDITIONS)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    start = time.perf_counter()
    with mpmath.workdps(DIGITS):
        text = table(run(options.problems, options.ratios, options.conditions))
    text += f"\n{options.problems} problems in each row; {time.perf_counter() - start:.0f} s.\n"
    if options.out is None:
        print(text)
    else:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
