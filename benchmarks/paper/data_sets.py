"""What the data sets of results_table.py cover: the range of each column, and how far angles turn.

Writes one row per data set and column to a CSV (what is there already is not simulated again), and a page beside it.
Training sets have random state s, test sets 1000 + s.

    python benchmarks/paper/data_sets.py          # five systems, four seeds: two minutes
    python benchmarks/paper/data_sets.py --quick  # fewer trajectories, one seed
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
from harness import Row, column, figure_of
from paper.models import QUICK_TRAJECTORIES, SYSTEMS
from skevgp.datasets import make_dynamics
from skevgp.robots import layout_of


@dataclass(frozen=True)
class Cell:
    """One data set.

    Attributes
    ----------
    system : str
    random_state : int
    size : {"full", "quick"}
    """

    system: str
    random_state: int
    size: str


def run(cell: Cell) -> list[dict[str, Any]]:
    """Simulate it, and look at each column of its inputs."""
    found = make_dynamics(
        cell.system, QUICK_TRAJECTORIES if cell.size == "quick" else None, random_state=cell.random_state
    )
    return [
        {
            **{name: getattr(cell, name) for name in ("system", "random_state", "size")},
            "column": name,
            "low": values.min(),
            "high": values.max(),
            "std": values.std(),
            "beyond_a_turn": (np.abs(values) > np.pi).mean(),
            "n_rows": len(values),
            **harness.provenance(),
        }
        for name, values in zip(found.feature_names, found.data.T, strict=True)
    ]


def say(rows: list[dict[str, Any]]) -> str:
    return ", ".join(f"{row['column']} {row['low']:.2f} to {row['high']:.2f}" for row in rows)


def is_angle(row: Row) -> bool:
    """Whether the column is a revolute joint's position."""
    layout = layout_of(row["system"])
    return dict(zip(layout.position_names, layout.revolute, strict=True)).get(row["column"], False)


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: of each angle the range of training and test sets."""
    lines = []
    for system in dict.fromkeys(row["system"] for row in rows):
        for name in layout_of(system).column_names:
            own = [row for row in rows if (row["system"], row["column"]) == (system, name)]
            line = [system, name]
            for test in (False, True):
                part = [row for row in own if (int(row["random_state"]) >= 1000) is test]
                low, high, beyond = (column(part, what) for what in ("low", "high", "beyond_a_turn"))
                line += ["; ".join(f"{a:.1f} to {b:.1f}" for a, b in zip(low, high, strict=True))]
                line += [f"{beyond.mean():.1%}" if is_angle(own[0]) else ""]
            lines.append([*line, figure_of(column(own, "std").mean())])
    header = ["system", "column", "training sets", "rows beyond ±π", "test sets", "rows beyond ±π", "std"]
    return [
        "# What the data sets cover",
        "Written by `benchmarks/paper/data_sets.py`. Lowest and highest value of each data set (rad, m, s, N); rows "
        f"beyond ±π and std: means over data sets. {harness.provenance_text(rows)}",
        harness.table(header, lines),
    ]


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="12 trajectories, one seed", seeds="seeds 0, 1, ...; default: 4, quick 1", systems=SYSTEMS
    )
    options = parser.parse_args()
    output, size = harness.output_path(options, "data_sets"), "quick" if options.quick else "full"
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    states = [offset + seed for offset, seed in itertools.product((0, 1000), range(n_seeds))]
    cells = [Cell(system, state, size) for system, state in itertools.product(options.systems, states)]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    rows = [row for row in harness.read(output) if row["size"] == size]
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
