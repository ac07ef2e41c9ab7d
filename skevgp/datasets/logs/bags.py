"""Logs that are rosbag2 recordings, read without ROS."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from ...utils.optional import require
from .recording import Recording, Signals

SUFFIXES = (".db3", ".mcap")
_STATES, _TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
# Signals, and what messages of a type, or the points of a trajectory, call them.
_FIELDS = {
    _STATES: {"position": "position", "velocity": "velocity", "effort": "effort"},
    _TRAJECTORY: {
        "position": "positions",
        "velocity": "velocities",
        "acceleration": "accelerations",
        "effort": "effort",
    },
}
_NANO = 1e-9


def read_bag(
    path: Path,
    topic: str | None,
    joints: Sequence[str] | None,
    ignored: Collection[str] = (),
    frame_id: str | None = None,
) -> Recording:
    """Read joint states or trajectories from a file, or from a folder with a metadata.yaml."""
    kind, received, messages = _messages(path, topic)
    frames = sorted({message.header.frame_id for message in messages})
    choice = f"Choose one by frame_id: {frames}." if len(frames) > 1 else ""
    if frame_id is not None:
        if frame_id not in frames:
            raise ValueError(f"frame_id={frame_id!r} is in no header; the messages have {frames}.")
        chosen = [message.header.frame_id == frame_id for message in messages]
        received, messages = received[chosen], [one for one, mine in zip(messages, chosen, strict=True) if mine]
        choice = ""
    if kind == _STATES:
        stamps = np.array([_nanoseconds(message.header.stamp) for message in messages], dtype=np.int64)
        times = stamps if stamps.all() else received  # a driver that leaves one out sets none that can be trusted
        rows = [(message.name, message) for message in messages]
    else:
        points = [
            (_nanoseconds(m.header.stamp) or start, m.joint_names, point)
            for m, start in zip(messages, received.tolist(), strict=True)
            for point in m.points
        ]
        times = np.array([start + _nanoseconds(p.time_from_start) for start, _, p in points], dtype=np.int64)
        rows = [(names, point) for _, names, point in points]
    if not rows:
        raise ValueError("the topic has no rows.")
    names = _joints([its for its, _ in rows], joints)
    twice = {index: why for index, (its, _) in enumerate(rows) if (why := _twice(its, names))}
    mine = sorted({*twice, *(index for index, (its, _) in enumerate(rows) if set(names) <= set(its))})
    at_ends = [*rows[: mine[0]], *rows[mine[-1] + 1 :]]
    n_passed = sum(not its or not set(names).isdisjoint(its) for its, _ in at_ends)
    hint = "" if joints is not None else "; say by joints which you mean, if you do not need it"
    refused = {row: twice[index] + hint for row, index in enumerate(mine) if index in twice}
    problems: dict[int, str] = {}
    signals = {
        title: _signal([(rows[index][0], getattr(rows[index][1], field)) for index in mine], names, title, problems)
        for title, field in _FIELDS[kind].items()
        if title not in ignored
    }
    for title in ("position", "effort"):
        if signals[title] is None:
            raise ValueError(f"no message has a value of the {title}.")
    times = times[mine]
    # The difference first: nanoseconds since 1970 have more digits than a float.
    time = (times - times[0]) * _NANO
    return Recording(
        Signals(time, signals["position"], signals.get("velocity"), signals.get("acceleration"), signals["effort"]),
        names,
        float(times[0] * _NANO),
        problems,
        refused,
        n_passed,
        choice,
    )


def _twice(names: list[str], wanted: list[str]) -> str:
    """Return an error's words if a message has one of the wanted joints twice, else ""."""
    twice = next((name for place, name in enumerate(names) if name in names[:place] and name in wanted), None)
    return "" if twice is None else f"names the joint {twice!r} twice, so that its values are not known"


def _messages(path: Path, topic: str | None) -> tuple[str, np.ndarray, list[Any]]:
    """Return the type of a topic's messages, the times at which they were received (ns), and the messages."""
    if path.suffix.lower() != ".mcap" and set("#?%") & set(str(path)):
        # rosbags makes the path part of an address as it is, by which SQLite may find another file.
        raise ValueError("the path of an SQLite recording must not have #, ? or % in it. Rename the file.")
    rosbag2 = require("rosbags.rosbag2", "Reading rosbag2 files")
    typesys = require("rosbags.typesys", "Reading rosbag2 files")
    try:
        path.stat()
        _check_databases(path)
        with rosbag2.Reader(path) as reader:
            topics = {connection.topic: connection.msgtype for connection in reader.connections}
            chosen = _topic(topics, topic)
            # The message types that ROS defines, not those that the file does, of which rosbags would make code.
            store = typesys.get_typestore(typesys.Stores.LATEST)
            connections = [connection for connection in reader.connections if connection.topic == chosen]
            found = [
                (received, store.deserialize_cdr(data, topics[chosen]))
                for _, received, data in reader.messages(connections=connections)
            ]
    except _TopicError:
        raise
    except Exception as error:  # rosbags raises any type for a broken file; MemoryError for a wrong size in it
        why = str(error) or "a size in it may be wrong"
        raise ValueError(f"it cannot be read as a rosbag2 recording ({type(error).__name__}: {why}).") from error
    if not found:
        raise ValueError(f"the topic {chosen!r} has no messages.")
    return topics[chosen], np.array([received for received, _ in found], dtype=np.int64), [m for _, m in found]


def _check_databases(path: Path) -> None:
    """Refuse damaged SQLite files, of which SQLite itself may read wrong rows in silence."""
    for file in path.glob("*.db3") if path.is_dir() else [path] * (path.suffix.lower() == ".db3"):
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            (state,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise ValueError(f"SQLite finds it damaged: {state}")


class _TopicError(ValueError):
    """An error about the topic, which passes unchanged."""


def _topic(topics: dict[str, str], topic: str | None) -> str:
    """Choose the topic that is asked for, or the only one with joint states or trajectories."""
    known = [name for name, kind in topics.items() if kind in (_STATES, _TRAJECTORY)]
    if topic is not None and topic not in known:
        raise _TopicError(f"topic={topic!r} is not a topic with joint states or trajectories; the file has {topics}.")
    if topic is None and len(known) != 1:
        many = f"several topics have such messages, give one of them as topic: {known}"
        raise _TopicError(
            f"{many}." if known else f"no topic has messages of the type {_STATES} or {_TRAJECTORY}; it has {topics}."
        )
    return known[0] if topic is None else topic


def _joints(sets: list[list[str]], joints: Sequence[str] | None) -> list[str]:
    """Choose the joints: those asked for, or those of the messages if all of these have the same."""
    if joints is None:
        # A driver's first and last messages may name few joints, or none.
        most = max(sets, key=lambda names: len(set(names)))
        whole = [index for index, names in enumerate(sets) if set(names) == set(most)]
        differing = {
            tuple(sorted(names))
            for index, names in enumerate(sets)
            if not set(names) <= set(most) or (whole[0] < index < whole[-1] and names and not _twice(names, most))
        } | {tuple(sorted(most))}
        if len({frozenset(names) for names in differing}) > 1:
            raise ValueError(f"messages have different joints, {sorted(differing)}. Choose some by joints=[...].")
        return list(dict.fromkeys(most))
    if not any(set(joints) <= set(names) for names in sets):
        known = sorted({name for names in sets for name in names})
        raise ValueError(f"no message has all of joints={list(joints)}; they have {known}.")
    return list(joints)


def _signal(rows: list[tuple[list[str], Any]], joints: list[str], title: str, problems: dict[int, str]) -> Any:
    """Return the joints' values (n, n_joints), NaN of messages without them; None if no message has any."""
    if not any(len(values) for _, values in rows):
        return None
    found = np.full((len(rows), len(joints)), np.nan)
    for row, (names, values) in enumerate(rows):
        if len(values) == len(names) and set(joints) <= set(names):
            found[row] = [values[names.index(joint)] for joint in joints]
        else:
            problems.setdefault(row, f"the message has {len(values)} values of {title} for {len(names)} names")
    return found


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)
