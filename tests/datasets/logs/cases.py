"""A motion that is known exactly, and files that a robot could have written of it."""

import gzip
import sqlite3
import struct

import numpy as np

FREQUENCIES = 2.0 * np.pi * np.array([[0.2, 0.5, 0.9], [0.15, 0.4, 1.1]])  # of joint 1 and 2, rad/s
AMPLITUDES = np.array([[0.5, 0.2, 0.1], [0.7, -0.3, 0.05]])
HEADER = ["t", "q_1", "q_2", "mode", "dq_1", "dq_2", "i_1", "i_2"]
BY_NAME = {"time": "t", "position": "q_*", "velocity": "dq_*", "current": ["i_1", "i_2"]}
BY_NUMBER = {"time": 0, "position": range(1, 3), "velocity": [4, 5], "current": (6, 7)}


def motion(t):
    """Positions, velocities, accelerations and currents, each (n, 2); two seconds' delay between joints."""
    phase = FREQUENCIES * np.asarray(t, dtype=float)[:, np.newaxis, np.newaxis]
    q = np.sum(AMPLITUDES * np.sin(phase), axis=2)
    dq = np.sum(AMPLITUDES * FREQUENCIES * np.cos(phase), axis=2)
    ddq = -np.sum(AMPLITUDES * FREQUENCIES**2 * np.sin(phase), axis=2)
    return q, dq, ddq, 2.0 + 0.5 * ddq + 0.1 * dq


def irregular_times(duration=14.0, seed=0):
    """Rows about every 8 ms, a jitter of 4 ms."""
    steps = np.arange(0.0, duration, 0.008)
    return steps + np.random.RandomState(seed).uniform(0.0, 0.004, len(steps))


def table_of(t):
    q, dq, _, current = motion(t)
    return np.column_stack([t, q, np.zeros(len(q)), dq, current])


def text_of(table, number="%.17g", delimiter=","):
    """Its rows as lines. Formatting all at once is much faster than np.savetxt."""
    row = delimiter.join([number] * table.shape[1]) + "\n"
    return row * len(table) % tuple(table.ravel().tolist())


def write_table(path, table, header=HEADER, delimiter=","):
    text = "" if header is None else delimiter.join(header) + "\n"
    text += text_of(table, "%.12g", delimiter)
    with gzip.open(path, "wt") if path.suffix == ".gz" else path.open("w") as file:
        file.write(text)
    return path


def states_of_db3(path):
    """Times (ns) and signals of the joint states in a file: CDR read by hand, without rosbags."""
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    rows = connection.execute("SELECT timestamp, data FROM messages ORDER BY timestamp").fetchall()
    connection.close()
    stamps, signals = [], []
    for _, data in rows:
        assert data[:4] == b"\x00\x01\x00\x00"  # CDR, little-endian
        body, place = data[4:], 0

        def take(form, size, body=body):
            nonlocal place
            place += -place % size
            (value,) = struct.unpack_from("<" + form, body, place)
            place += size
            return value

        def text(body=body):
            nonlocal place
            length = take("I", 4)
            place += length
            return body[place - length : place - 1].decode()

        stamps.append(take("i", 4) * 10**9 + take("I", 4))
        text()
        names = [text() for _ in range(take("I", 4))]
        signals.append([[take("d", 8) for _ in range(take("I", 4))] for _ in range(3)])
    return np.array(stamps), names, np.array(signals).transpose(1, 0, 2)


PENDULUM = {"inertia": 0.25, "weight": 4.905, "viscous": 0.1, "coulomb": 0.3}


def pendulum(step=0.01, duration=20.0, noise=0.02):
    """Rows of time, position, velocity and effort of a pendulum with friction."""
    t = np.arange(0.0, duration, step)
    q = np.sin(t) + 0.4 * np.sin(2.7 * t)
    dq = np.cos(t) + 1.08 * np.cos(2.7 * t)
    ddq = -np.sin(t) - 2.916 * np.sin(2.7 * t)
    effort = np.column_stack([ddq, np.sin(q), dq, np.sign(dq)]) @ list(PENDULUM.values())
    return np.column_stack([t, q, dq, effort + noise * np.random.default_rng(0).standard_normal(len(t))])


def identified(log):
    """The pendulum's parameters by least squares, without the rows in which friction changes its sign."""
    (q, dq, ddq), effort = log.data.T, log.target[:, 0]
    moves = np.abs(dq) > 0.3
    weights = np.linalg.lstsq(np.column_stack([ddq, np.sin(q), dq, np.sign(dq)])[moves], effort[moves], rcond=None)[0]
    return dict(zip(PENDULUM, weights.tolist(), strict=True))
