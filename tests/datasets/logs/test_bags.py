import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from skevgp.datasets import load_log

from .cases import irregular_times, motion, states_of_db3

UR10 = Path(__file__).parents[2] / "data" / "ur10.db3"
JOINTS = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
STORE = get_typestore(Stores.LATEST)
TYPES = STORE.types
STATES, TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
START = 1_700_000_000_123_456_789  # ns since 1970
T = irregular_times(2.5)
NS = np.round(T * 1e9).astype(np.int64)


def stamp(nanoseconds, kind="builtin_interfaces/msg/Time"):
    return TYPES[kind](sec=int(nanoseconds // 10**9), nanosec=int(nanoseconds % 10**9))


def header(nanoseconds, frame_id=""):
    return TYPES["std_msgs/msg/Header"](stamp=stamp(nanoseconds), frame_id=frame_id)


def state(nanoseconds, names, q, dq=(), effort=()):
    arrays = (np.asarray(values, dtype=float) for values in (q, dq, effort))
    return TYPES[STATES](header(nanoseconds), names, *arrays)


def states(start=START, names=("a", "b"), velocity=True):
    """What a robot sends that moves as it should; received 3 ms late, more or less if it has a clock."""
    q, dq, _, current = motion(T)
    for row, t in enumerate(NS.tolist()):
        late = 3_000_000 + (row % 3 * 100_000 if start else 0)
        yield (
            START + t + late,
            state(start + t if start else 0, list(names), q[row], dq[row] if velocity else (), current[row]),
        )


def trajectory(effort=True, start=0):
    q, dq, ddq, current = motion(T)
    point = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"]
    points = [
        point(
            q[row],
            dq[row],
            ddq[row],
            current[row] if effort else np.empty(0),
            stamp(t, "builtin_interfaces/msg/Duration"),
        )
        for row, t in enumerate(NS.tolist())
    ]
    return START, TYPES[TRAJECTORY](header(start), ["a", "b"], points)


def write(folder, topics, plugin=StoragePlugin.MCAP):
    """A recording of topics, {name: (type, [(received, message), ...])}; returns its only file."""
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for name, (kind, messages) in topics.items():
            connection = writer.add_connection(name, kind, typestore=STORE)
            for received, message in messages:
                writer.write(connection, received, STORE.serialize_cdr(message, kind))
    (file,) = [path for path in folder.iterdir() if path.suffix in (".mcap", ".db3")]
    return file


def write_states(folder, **arguments):
    return write(folder, {"/joint_states": (STATES, states(**arguments))})


def assert_recorded(log, rows=slice(None)):
    raw = log.recordings[0].raw
    q, dq, _, current = motion(T[rows])
    assert_allclose(raw.time, (NS[rows] - NS[rows][0]) * 1e-9, rtol=0, atol=1e-12)
    assert_allclose(np.hstack([raw.position, raw.velocity, raw.torque]), np.hstack([q, dq, current]), rtol=1e-15)


def test_real_recording_is_read():
    stamps, names, signals = states_of_db3(UR10)
    log = load_log(UR10)
    raw = log.recordings[0].raw
    assert log.joint_names == names == JOINTS
    assert len(stamps) == 300
    assert_allclose(raw.time, (stamps - stamps[0]) * 1e-9, rtol=0, atol=1e-12)
    for recorded, expected in zip((raw.position, raw.velocity, raw.torque), signals, strict=True):
        assert_array_equal(recorded, expected)


@pytest.mark.parametrize("plugin", list(StoragePlugin), ids=str)
@pytest.mark.parametrize("whole", [False, True], ids=["file", "folder"])
def test_recordings_are_read_with_and_without_their_metadata(tmp_path, plugin, whole):
    file = write(tmp_path / "bag", {"/joint_states": (STATES, states())}, plugin)
    if not whole:
        file = shutil.copy(file, tmp_path)
        shutil.rmtree(tmp_path / "bag")
    log = load_log(tmp_path / "bag" if whole else file)
    assert_recorded(log)
    assert log.recordings[0].start == pytest.approx((START + NS[0]) * 1e-9)
    assert log.joint_names == ["a", "b"]


@pytest.mark.parametrize(
    ("mode", "plugin"),
    [
        (CompressionMode.STORAGE, StoragePlugin.MCAP),
        (CompressionMode.FILE, StoragePlugin.SQLITE3),
        (CompressionMode.MESSAGE, StoragePlugin.SQLITE3),
    ],
    ids=["chunks", "file", "messages"],
)
def test_compressed_recordings_are_read(tmp_path, mode, plugin):
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", STATES, typestore=STORE)
        for received, message in states():
            writer.write(connection, received, STORE.serialize_cdr(message, STATES))
    assert_recorded(load_log(tmp_path / "bag"))


def test_trajectory_brings_its_accelerations(tmp_path):
    log = load_log(write(tmp_path / "bag", {"/plan": (TRAJECTORY, [trajectory()])}))
    assert_recorded(log)
    assert_allclose(log.recordings[0].raw.acceleration, motion(T)[2], rtol=1e-15)
    assert_allclose(log.data[:, 4:], motion(log.time + T[0])[2], atol=0.01)


def test_joints_are_chosen_and_ordered_by_name(tmp_path):
    file = write_states(tmp_path / "bag")
    log, other = load_log(file), load_log(file, joints=["b", "a"])
    assert other.joint_names == ["b", "a"]
    assert other.feature_names == ["b", "a", "db/dt", "da/dt", "d2b/dt2", "d2a/dt2"]
    assert_array_equal(other.target, log.target[:, ::-1])
    assert_allclose(load_log(file, joints=["b"]).data, log.data[:, 1::2], atol=1e-12)


def test_one_of_several_topics_is_chosen(tmp_path):
    others = [(START + t, state(START + t, ["c"], [1.0], [1.0], [1.0])) for t in NS.tolist()]
    file = write(tmp_path / "bag", {"/mine": (STATES, states()), "/other": (STATES, others)})
    assert_recorded(load_log(file, topic="/mine"))
    with pytest.raises(ValueError, match=r"bag.mcap: several topics .*: \['/mine', '/other'\]"):
        load_log(file)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"topic": "/joints"},
            r"topic='/joints' is not a topic .* the file has \{'/joint_states': 'sensor_msgs/msg/Joi",
        ),
        ({"joints": ["elbow"]}, r"no message has all of joints=\['elbow'\]; they have \['elbow_joint', "),
        ({"columns": {"time": 0, "position": 1, "effort": 2}}, "columns is for tables. For a rosbag2"),
        ({"gains": [1.0, 2.0]}, r"gains must be .* one for each of the 6 joints; got \[1.0, 2.0\]"),
    ],
)
def test_invalid_recording_arguments_raise(arguments, message):
    with pytest.raises(ValueError, match=f"ur10.db3: {message}"):
        load_log(UR10, **arguments)


def test_recording_without_joint_states_lists_its_topics(tmp_path):
    text = TYPES["std_msgs/msg/String"]
    file = write(tmp_path / "bag", {"/said": ("std_msgs/msg/String", [(START, text("q"))])})
    with pytest.raises(ValueError, match=r"no topic has messages of .*JointTrajectory; it has \{'/said': 'std_msgs/ms"):
        load_log(file)


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        ([(START, state(START, ["a"], [1.0], [1.0]))], "no message has a value of the effort"),
        ([(START, state(START, ["a"], [], [], [1.0]))], "no message has a value of the position"),
        ([(START, state(START, ["a", "b"], [1.0, 1.0], [1.0], [1.0, 1.0]))], "has 1 values of velocity for 2 names"),
        ([(START, state(START, ["a"], [1.0], [1.0], [1.0]))], "its 1 rows do not have two different times"),
        ([], "the topic '/joint_states' has no messages"),
    ],
)
def test_missing_signals_raise(tmp_path, messages, message):
    with pytest.raises(ValueError, match=message):
        load_log(write(tmp_path / "bag", {"/joint_states": (STATES, messages)}))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9], ids=str)
@pytest.mark.parametrize("plugin", list(StoragePlugin), ids=str)
def test_broken_files_raise(tmp_path, plugin, share):
    file = write(tmp_path / "bag", {"/joint_states": (STATES, states())}, plugin)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=f"bag{file.suffix}: it cannot be read as a rosbag2 recording"):
        load_log(file)


def test_mcap_record_longer_than_its_file_raises(tmp_path):
    header = b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, 12) + struct.pack("<I4sI", 4, b"ros2", 0)
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + b"\x89MCAP0\r\n"
    file = tmp_path / "log.mcap"
    file.write_bytes(header + struct.pack("<BQ", 3, 2**40) + footer)
    with pytest.raises(ValueError, match=r"log.mcap: it cannot be read as a rosbag2 recording \(\w+: .+\)"):
        load_log(file)


def test_database_with_a_page_in_two_places_raises(tmp_path):
    """SQLite would read the rows of that page twice."""
    data = bytearray(UR10.read_bytes())
    size = int.from_bytes(data[16:18], "big")
    pages = range(size, len(data), size)
    tree = next(page for page in pages if data[page] == 5 and int.from_bytes(data[page + 3 : page + 5], "big") > 1)
    cells = [int.from_bytes(data[tree + 12 + 2 * i : tree + 14 + 2 * i], "big") for i in range(2)]
    data[tree + cells[1] : tree + cells[1] + 4] = data[tree + cells[0] : tree + cells[0] + 4]
    file = tmp_path / "log.db3"
    file.write_bytes(data)
    with pytest.raises(ValueError, match=r"log.db3: it cannot be read as .* SQLite finds it damaged: "):
        load_log(file)


@pytest.mark.parametrize("name", ["log.db3", "log.mcap"])
def test_missing_recording_raises_and_is_not_created(tmp_path, name):
    with pytest.raises(ValueError, match=f"{name}: it cannot be read as a rosbag2 recording .FileNotFoundError"):
        load_log(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_undecodable_message_raises(tmp_path):
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", STATES, typestore=STORE)
        writer.write(connection, START, b"\x00\x01\x00\x00" + b"\xff" * 40)
    with pytest.raises(ValueError, match="bag.mcap: it cannot be read as a rosbag2 recording"):
        load_log(tmp_path / "bag" / "bag.mcap")


def test_missing_rosbags_raises(monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(ImportError, match=r"Reading rosbag2 files needs .* 'rosbags'.*pip install '\.\[logs\]'"):
        load_log(UR10)


def spoilt_states(rows, **fields):
    """Joint states of which some have other fields."""
    messages = list(states())
    for row in rows:
        for name, values in fields.items():
            setattr(messages[row][1], name, values if name == "name" else np.array(values))
    return {"/joint_states": (STATES, messages)}


INCOMPLETE = [
    pytest.param(field, values, marks=[] if number in (i, (i + 1) % 3) else pytest.mark.long, id=f"{field}-{values}")
    for number, field in enumerate(["effort", "velocity", "position"])
    for i, values in enumerate([[], [1.0], [np.nan, np.nan]])
]


@pytest.mark.parametrize(("field", "values"), INCOMPLETE)
def test_incomplete_messages_at_the_ends_are_left_out_and_counted(tmp_path, field, values):
    """Drivers publish before the motors answer."""
    file = write(tmp_path / "bag", spoilt_states([0, 1, 2, len(T) - 1], **{field: values}))
    log = load_log(file)
    assert log.recordings[0].n_incomplete == 4
    q, dq, _, current = motion(T[3:-1])
    raw = log.recordings[0].raw
    assert_allclose(np.hstack([raw.position, raw.velocity, raw.torque]), np.hstack([q, dq, current]), rtol=1e-15)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("effort", r"row 7 lacks the effort of joint 'a' \(the message has 0 values of effort for 2 names\)"),
        ("velocity", r"row 7 lacks the velocity of joint 'a' .*, or pass velocity=\"derive\" to ignore it"),
    ],
)
def test_incomplete_message_between_others_is_an_error_but_where_keep_leaves_it_out(tmp_path, field, message):
    file = write(tmp_path / "bag", spoilt_states([7], **{field: []}))
    with pytest.raises(ValueError, match=f"bag.mcap: {message}"):
        load_log(file)
    assert load_log(file, keep=slice(8, None)).recordings[0].n_incomplete == 0
    if field == "velocity":
        assert load_log(file, velocity="derive").recordings[0].raw.velocity is None


def test_joint_that_a_message_names_twice_raises(tmp_path):
    file = write(tmp_path / "one", spoilt_states([4], name=["a", "a"]))
    with pytest.raises(ValueError, match="row 4 names the joint 'a' twice, so that its values are not known; say by"):
        load_log(file)
    assert load_log(file, keep=slice(5, None)).joint_names == ["a", "b"]
    every = write(tmp_path / "every", spoilt_states(range(len(T)), name=["a", "a"]))
    with pytest.raises(ValueError, match="row 0 names the joint 'a' twice, so that its values are not known"):
        load_log(every)
    first = write(tmp_path / "first", spoilt_states([0, 1], name=["a", "a"]))
    with pytest.raises(ValueError, match="row 0 names the joint 'a' twice, so that its values are not known"):
        load_log(first)


def test_name_twice_does_not_matter_to_other_joints(tmp_path):
    fields = {"position": [0.0, 0.0, 1.0], "velocity": [0.0, 0.0, 0.0], "effort": [0.0, 0.0, 2.0]}
    file = write(tmp_path / "hand", spoilt_states(range(len(T)), name=["finger", "finger", "a"], **fields))
    raw = load_log(file, joints=["a"], rest_velocity=0.0).recordings[0].raw
    assert_allclose(raw.position, 1.0)
    with pytest.raises(ValueError, match="names the joint 'finger' twice"):
        load_log(file, joints=["finger"])


def test_message_that_names_few_joints_between_others_raises(tmp_path):
    fields = {"name": ["a"], "position": [1.0], "velocity": [1.0], "effort": [1.0]}
    with pytest.raises(ValueError, match=r"messages have different joints, \[\('a',\), \('a', 'b'\)\]"):
        load_log(write(tmp_path / "bag", spoilt_states([7], **fields)))


@pytest.mark.parametrize("first", [range(0), range(3)], ids=["in all messages", "after messages without velocity"])
def test_velocity_that_one_joint_never_has_raises(tmp_path, first):
    topics = spoilt_states(first, velocity=[])
    for row, (_, message) in enumerate(topics["/joint_states"][1]):
        if row not in first:
            message.velocity = np.array([message.velocity[0], np.nan])
    with pytest.raises(ValueError, match="the velocity of joint 'b' is not finite in any row kept: the driver may nev"):
        load_log(write(tmp_path / "bag", topics))


def test_messages_of_other_joints_are_passed_over(tmp_path):
    hand = [(START + t + 1, state(START + t + 1, ["finger"], [0.0])) for t in NS[::10].tolist()]
    file = write(tmp_path / "bag", {"/joint_states": (STATES, [*states(), *hand])})
    assert_recorded(load_log(file, joints=["a", "b"]))
    with pytest.raises(ValueError, match=r"messages have different joints, \[\('a', 'b'\), \('finger',\)\]"):
        load_log(file)


def test_frame_id_chooses_one_of_two_publishers(tmp_path):
    q, dq, _, current = motion(T)
    messages = []
    for row, t in enumerate((START + NS).tolist()):
        for frame_id, share, late in (("arm", 1.0, 0), ("mock", 0.0, 1_000_000)):
            arrays = (share * one[row] for one in (q, dq, current))
            message = TYPES[STATES](header(t + late, frame_id), ["a", "b"], *arrays)
            messages.append((t + late, message))
    file = write(tmp_path / "bag", {"/joint_states": (STATES, messages)})
    with pytest.raises(ValueError, match=r"leap back and forth .* Choose one by frame_id: \['arm', 'mock'\]"):
        load_log(file)
    assert_recorded(load_log(file, frame_id="arm"))
    with pytest.raises(ValueError, match=r"frame_id='leg' is in no header; the messages have \['arm', 'mock'\]"):
        load_log(file, frame_id="leg")
