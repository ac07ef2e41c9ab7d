"""Damaged logs, and URDF files that are damaged or made to do harm: each must be refused by a ValueError that names the
file, or give finite numbers; in a minute, in little memory, and without an end of the interpreter (Pinocchio, SQLite
and decompressors are C and C++).

    python -m tests.long.hostile_files urdfs --files 10000
    python -m tests.long.hostile_files tables recordings --files 10000

Files are read in a process of its own, which is started again after what ends it, or after a file that takes a minute.
"""

import argparse
import json
import os
import resource
import selectors
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

from tests import hostile

SECONDS = 60.0
# Of addresses, beside what the packages take: what asks for more gets none. And what a file may take, bytes.
ADDRESSES, MEMORY = 2**31, 2**28
OUTCOMES = ("refused", "right", "finite")
ROBOTS = ("ur5", "double_pendulum", "double_pendulum_continuous", "panda", "kinova", "z1")


def good_urdfs(folder):
    from skevgp.robots.loading import _collection
    from tests.robots.test_urdf import ARM

    return [(".urdf", ARM.encode()), *((".urdf", _collection()[name].read_bytes()) for name in ROBOTS)]


def good_tables(folder):
    from tests.datasets.logs.cases import irregular_times, table_of, write_table

    table = table_of(irregular_times(3.0))
    files = [write_table(folder / "a.csv", table), write_table(folder / "b.csv", table, None)]
    return [(".csv", file.read_bytes()) for file in files] + [(".txt", files[0].read_bytes().replace(b",", b" "))]


def good_recordings(folder):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    from tests.datasets.logs.test_bags import STATES, STORE, TRAJECTORY, UR10, states, trajectory, write, write_states

    database = write(folder / "db", {"/joint_states": (STATES, states())}, StoragePlugin.SQLITE3)
    files = [UR10, database, write_states(folder / "plain")]
    for name, messages, kind in (("packed", states(), STATES), ("plan", [trajectory()], TRAJECTORY)):
        writer = Writer(folder / name, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/a", kind, typestore=STORE)
            for received, message in messages:
                writer.write(connection, received, STORE.serialize_cdr(message, kind))
        files.append(next((folder / name).glob("*.mcap")))
    return [(file.suffix, file.read_bytes()) for file in files]


def read_log(path):
    from skevgp.datasets import load_log
    from tests.datasets.logs.cases import BY_NUMBER

    log = load_log(path, columns=None if path.suffix in (".db3", ".mcap") else BY_NUMBER)
    return log.data, log.target


def read_robot(path):
    from skevgp.features import NominalDynamics, RigidBodyRegressor
    from skevgp.robots import inertial_parameters, load_robot, write_urdf

    model = load_robot(path)
    rows = np.full((2, 3 * model.nv), 0.1)
    try:
        parameters, regressor = inertial_parameters(model), RigidBodyRegressor(path).fit_transform(rows)
        NominalDynamics(path).fit(rows[:, : 2 * model.nv + model.nv]).transform(rows)
        write_urdf(path, path.with_name("new.urdf"), parameters)
        again = inertial_parameters(load_robot(path.with_name("new.urdf")))
    except ValueError as error:
        # Of good files whose numbers no robot has: the arithmetic ends, and says so.
        return None if str(error) else (np.array([np.nan]),)
    assert np.allclose(again, parameters, rtol=1e-6, atol=1e-6 * np.abs(parameters).max())
    return parameters, regressor


KINDS = {
    "urdfs": (good_urdfs, read_robot, hostile.OF_XML),
    "tables": (good_tables, read_log, hostile.OF_TABLES),
    "recordings": (good_recordings, read_log, hostile.OF_RECORDINGS),
}


def outcome(read, path, expected):
    try:
        found = read(path)
    except ValueError as error:
        return "refused" if type(error) is ValueError and str(path) in str(error) else f"unclear: {error!r}"
    except BaseException as error:
        return f"raised {error!r}"
    if found is None:
        return "refused"
    if expected is not None and all(np.array_equal(*pair) for pair in zip(found, expected, strict=True)):
        return "right"
    return "finite" if all(np.isfinite(each).all() for each in found) else "read, but not all of it is finite"


def peak_memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def work(kind, seed, first, stop):
    """Read files and print, line by line, what came of each."""
    good, read, damages = KINDS[kind]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        files = good(Path(folder))
        expected = []
        for number, (ending, data) in enumerate(files):
            path = Path(folder, f"good{number}{ending}")
            path.write_bytes(data)
            expected.append(read(path))
            assert expected[-1] is not None
        size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + ADDRESSES, size + ADDRESSES))
        for number in range(first, stop):
            rng = np.random.RandomState([seed, number])
            which, damage = rng.randint(len(files)), damages[number % len(damages)]
            ending, data = files[which]
            data = damage(data, rng)
            path = Path(folder, f"file{number}{ending}{'.gz' if data.startswith(bytes([31, 139])) else ''}")
            path.write_bytes(data)
            print(json.dumps([number, damage.__name__]), flush=True)
            start = time.perf_counter()
            before = peak_memory()
            found = outcome(read, path, expected[which])
            if peak_memory() > before + MEMORY:
                found = f"took {(peak_memory() - before) / 2**20:.0f} MB of memory"
            print(json.dumps([number, damage.__name__, found, time.perf_counter() - start]), flush=True)
            path.unlink()
        print(json.dumps(peak_memory() / 2**20), flush=True)


def run(kind, n_files, seed=0, seconds=SECONDS):
    """Counts of outcomes by kind of damage, the defects, the longest time a file took, and the largest memory in MB."""
    counts, defects, longest, peak, first = Counter(), [], (0.0, ""), 0.0, 0
    while first < n_files:
        command = [sys.executable, "-m", "tests.long.hostile_files", kind, "--seed", str(seed)]
        with subprocess.Popen(
            [*command, "--work", str(first), str(n_files)],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
        ) as process:
            last = None
            for line in _lines(process, seconds):
                if isinstance(line, float):
                    peak = max(peak, line)
                elif len(line) == 2:
                    last = line
                else:
                    number, damage, found, took = line
                    longest, last, first = max(longest, (took, f"{number}: {damage}")), None, number + 1
                    if found not in OUTCOMES:
                        defects.append(f"{number}: {damage}: {found[:300]}")
                        found = "defect"
                    counts[damage, found] += 1
            process.kill()
        if last is None and first < n_files:
            raise RuntimeError(f"The process that reads {kind} ended with {process.returncode} before file {first}.")
        if last is not None:
            defects.append(f"{last[0]}: {last[1]}: ended the interpreter, or took more than {seconds} s")
            counts[last[1], "defect"] += 1
            first = last[0] + 1
    return counts, defects, longest, peak


def _lines(process, seconds):
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        rest = b""
        while selector.select(seconds) and (data := os.read(process.stdout.fileno(), 2**16)):
            *lines, rest = (rest + data).split(b"\n")
            yield from map(json.loads, lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+", choices=KINDS)
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.kinds[0], options.seed, *options.work)
        return
    wrong = []
    for kind in options.kinds:
        counts, defects, longest, peak = run(kind, options.files, options.seed)
        print(f"{kind:28}" + "".join(f"{each:>9}" for each in (*OUTCOMES, "defect")))
        for damage in sorted({damage for damage, _ in counts}):
            print(f"{damage:28}" + "".join(f"{counts[damage, each]:9}" for each in (*OUTCOMES, "defect")))
        total = Counter()
        for (_, found), count in counts.items():
            total[found] += count
        print(f"{'all':28}" + "".join(f"{total[each]:9}" for each in (*OUTCOMES, "defect")))
        print(f"longest {longest[0]:.2f} s ({longest[1]}); at most {peak:.0f} MB of memory")
        print("\n".join(defects[:40]), flush=True)
        wrong += defects
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
