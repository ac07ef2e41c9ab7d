import dataclasses
import importlib.metadata
import pickle
import re
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp import InverseDynamics
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForce, RigidBodyRegressor
from skevgp.robots import SYSTEMS, RigidBody, System, get_system, layout_of, list_robots, load_robot, loading

JOINT = """
  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/><axis xyz="{axis}"/>
    {limit}
  </joint>
  <link name="{child}">
    <inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0.01" ixz="0" iyz="0"/></inertial>
  </link>"""


def urdf(path, joints):
    """A chain of (name, kind, axis, effort)."""
    parts = ['<robot name="chain"><link name="base"/>']
    parent = "base"
    for name, kind, axis, effort in joints:
        limit = f'<limit lower="-1" upper="2" effort="{effort}" velocity="3"/>' if effort is not None else ""
        parts.append(JOINT.format(name=name, kind=kind, parent=parent, child=f"of_{name}", axis=axis, limit=limit))
        parent = f"of_{name}"
    path.write_text("".join(parts) + "</robot>")
    return path


@pytest.fixture
def chain(tmp_path):
    joints = [
        ("slide", "prismatic", "0 0 1", 5),
        ("turn", "continuous", "0 0.6 0.8", 7),
        ("loose", "revolute", "1 0 0", 0),
    ]
    return urdf(tmp_path / "chain.urdf", joints)


# --- names -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["panda", "ur5", "kinova", "talos_left_arm", "double_pendulum", "z1"])
def test_robots_of_the_collection_are_found_by_their_names(name):
    assert name in list_robots()
    assert load_robot(name).nv == layout_of(name).n_joints


@pytest.fixture
def without_collection(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "files", missing)
    monkeypatch.setattr(loading.sys, "prefix", "/nowhere")
    loading._collection.cache_clear()
    yield
    loading._collection.cache_clear()


def test_without_the_collection_the_systems_are_left_and_the_error_says_how_to_get_more(without_collection):
    assert list_robots() == sorted(SYSTEMS)
    assert load_robot("acrobot").nv == 2
    with pytest.raises(ValueError, match=r"pip install example-robot-data brings more"):
        load_robot("panda")


def test_collection_without_a_list_of_files_is_found_by_its_place(monkeypatch, tmp_path, chain):
    folder = tmp_path / "share" / "example-robot-data" / "robots" / "chain_description"
    folder.mkdir(parents=True)
    chain.rename(folder / "mine_robot.urdf")
    (folder / "broken.urdf").write_text("<robot")
    monkeypatch.setattr(importlib.metadata, "files", lambda name: None)
    monkeypatch.setattr(loading.sys, "prefix", str(tmp_path))
    loading._collection.cache_clear()
    try:
        assert list_robots() == [*sorted(SYSTEMS), "mine"]
        assert load_robot("mine").nv == 3
    finally:
        loading._collection.cache_clear()


# --- what can be loaded --------------------------------------------------------------------------------------------


def test_model_comes_back_as_it_is():
    model = load_robot("ur5")
    assert load_robot(model) is model
    assert load_robot(get_system("acrobot")) == load_robot("acrobot")


def test_continuous_joint_has_an_angle(chain):
    plain, model = pinocchio.buildModelFromUrdf(str(chain)), load_robot(chain)
    assert (plain.nq, plain.nv, model.nq, model.nv) == (4, 3, 3, 3)
    rng = np.random.default_rng(0)
    for q, v, force in rng.uniform(-2, 2, (5, 3, 3)):
        of_plain = np.r_[q[0], np.cos(q[1]), np.sin(q[1]), q[2]]
        expected = pinocchio.aba(plain, plain.createData(), of_plain, v, force)
        assert_allclose(pinocchio.aba(model, model.createData(), q, v, force), expected, rtol=1e-10)
    assert_array_equal(model.lowerPositionLimit, [-1.0, -np.inf, -1.0])
    assert_array_equal(model.upperPositionLimit, [2.0, np.inf, 2.0])
    assert_array_equal(model.upperEffortLimit, [5.0, 7.0, 0.0])


# --- joints that are locked ----------------------------------------------------------------------------------------

KINOVA = "j2s6s200_joint_"
ARM = [f"panda_joint{number}" for number in range(1, 8)]


def numbered(model):
    """The model with other numbers at each joint, and a gravity of its own."""
    model = model.copy()
    for start, name in enumerate(PER_JOINT, start=1):
        setattr(model, name, 10.0 * start + np.arange(model.nv))
    model.lowerEffortLimit = -np.array(model.upperEffortLimit)
    model.gravity.linear = np.array([1.0, 2.0, -9.0])
    return model


PER_JOINT = ("armature", "damping", "friction", "rotorInertia", "rotorGearRatio", "upperEffortLimit", "velocityLimit")


@pytest.mark.parametrize(
    ("name", "joints", "at"),
    [
        ("panda", ARM, {}),
        ("panda", ["panda_joint3", "panda_joint5"], {"panda_joint4": "upper"}),
        ("kinova", [KINOVA + "2", KINOVA + "4"], {KINOVA + "3": "lower", KINOVA + "5": "lower"}),
        ("acrobot", ["q2"], {}),
    ],
)
def test_locked_joints_stay_at_0_or_at_the_nearest_limit(name, joints, at):
    whole = numbered(load_robot(name))
    model, names = load_robot(whole, joints=joints), list(whole.names)[1:]
    assert list(model.names)[1:] == joints
    moving, rng = [names.index(joint) for joint in joints], np.random.default_rng(0)
    q, v, a = np.zeros((3, 5, whole.nv))
    for joint, limit in at.items():
        q[:, names.index(joint)] = getattr(whole, f"{limit}PositionLimit")[names.index(joint)]
    for rows in (q, v, a):
        rows[:, moving] = rng.uniform(-2.0, 2.0, (5, len(joints)))
    expected = RigidBody(whole).forces(q, v, a)[:, moving]
    found = RigidBody(model).forces(q[:, moving], v[:, moving], a[:, moving])
    assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    for kept in (*PER_JOINT, "lowerEffortLimit", "lowerPositionLimit", "upperPositionLimit"):
        assert_array_equal(getattr(model, kept), getattr(whole, kept)[moving], err_msg=kept)


def test_robot_with_locked_joints_serves_simulation_and_features():
    arm = load_robot("panda", joints=ARM)
    assert make_dynamics(arm, 1, n_steps=5, random_state=0).data.shape == (5, 21)
    two = load_robot("panda", joints=ARM[1:3])
    q, v, a = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 40, 2))
    torques = RigidBody(two).forces(q, v, a)
    X = np.hstack([q, v, a])
    model = pickle.loads(pickle.dumps(InverseDynamics(two, n_inducing=0).fit(X, torques)))
    assert model.score(X, torques) > 0.9999
    for frame in ("panda_link7", "panda_finger_joint1"):  # of a joint that moves, and of one that is locked
        assert arm.frames[arm.getFrameId(frame)].parentJoint == 7


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (
            ["panda_joint_1"],
            r"no joints \['panda_joint_1'\]. Did you mean 'panda_joint1' or .* Its joints are \['panda_",
        ),
        (ARM[::-1], r"once, in the order of the robot \['panda_joint1', .*; got \['panda_joint7'"),
        ([ARM[0], ARM[0]], r"each joint once, in the order of the robot \['panda_joint1'\]; got"),
        ([], r"must be a list of names, at least one; got \[\]"),
        ("panda_joint1", "must be a list of names, at least one; got 'panda_joint1'"),
    ],
)
def test_invalid_joints_raise(joints, message):
    with pytest.raises(ValueError, match=message):
        load_robot("panda", joints=joints)


def test_joints_without_a_motor_raise():
    """Their limits, all 0, would mean that no limit is known."""
    with pytest.raises(ValueError, match=r"None of joints=\['q1'\] has a motor.* are \['q2'\]"):
        load_robot("acrobot", joints=["q1"])


@pytest.mark.parametrize(("n_columns", "is_told"), [(21, True), (22, False), (30, False)])
def test_error_about_columns_says_how_to_lock_joints(n_columns, is_told):
    with pytest.raises(ValueError, match=rf"X has {n_columns} columns, but .* needs 27") as error:
        RigidBodyRegressor("panda").fit(np.zeros((3, n_columns)))
    assert ("give the robot as load_robot(robot, joints=[...]), which locks the others" in str(error.value)) == is_told


@pytest.mark.parametrize(("n_columns", "is_told"), [(4, True), (3, False), (7, False)])
def test_error_about_columns_knows_rows_of_log_transitions(n_columns, is_told):
    with pytest.raises(ValueError, match=r"needs 6: .*dt=\"column\"|joints=\[") as error:
        InertiaForce("double_pendulum").fit(np.ones((3, n_columns)))
    both = "which locks the others. If the last column is the time step of each row, also pass"
    assert (both in str(error.value)) == is_told


# --- layouts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lower", "upper", "driven", "limits"),
    [
        ([-2.0, 0.0], [0.0, 3.0], (0, 1), [[-2.0, 0.0], [0.0, 3.0]]),
        ([0.0, -1.0], [0.0, 0.0], (1,), [[0.0, -1.0], [0.0, 0.0]]),
        ([0.0, 0.0], [0.0, 0.0], (0, 1), [[-np.inf, -np.inf], [np.inf, np.inf]]),
        (None, [4.0, 0.0], (0,), [[-4.0, 0.0], [4.0, 0.0]]),
    ],
    ids=["one way each", "backwards only", "unknown", "lower never set"],
)
def test_motor_works_between_both_limits(lower, upper, driven, limits):
    model = pinocchio.Model()
    for parent, name in enumerate(("a", "b")):
        model.addJoint(parent, pinocchio.JointModelRX(), pinocchio.SE3.Identity(), name)
    model.upperEffortLimit = np.array(upper)
    if lower is not None:
        model.lowerEffortLimit = np.array(lower)
    assert layout_of(model).driven == driven
    assert_array_equal(loading.effort_limits(model), limits)


# --- what cannot ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ("bad.urdf", r"bad.urdf' is not a URDF that can be read"),
        ("nothing.urdf", r"^There is no file '[^']*'\.$"),
        ("nothing.xml", r"There is no file '.*the names that are known"),
        ("some/where", r"^There is no file '[^']*'\.$"),
        ("~nobody-of-this-name/a.urdf", r"^There is no file '[^']*'\.$"),
        (Path("folder"), r"is a folder; a robot is one URDF or MJCF file"),
        ("", "Unknown robot ''"),
        (Path("panda"), r"no file 'panda'; a robot's name must be a string, not a path"),
        (pinocchio.Model(), "has no joint that moves"),
        (
            pinocchio.buildSampleModelHumanoidRandom(),
            r"joint 'root_joint' of the type JointModelFreeFlyer.*base fixed",
        ),
    ],
    ids=lambda each: str(each)[:30],
)
def test_invalid_robot_raises(tmp_path, monkeypatch, robot, message):
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    Path("bad.urdf").write_text("<robot><link></robot>")
    with pytest.raises(ValueError, match=message):
        load_robot(robot)


@pytest.mark.parametrize(
    "joint", [pinocchio.JointModelSpherical(), pinocchio.JointModelPlanar(), pinocchio.JointModelTranslation()]
)
def test_joints_of_several_velocities_raise(joint):
    model = pinocchio.Model()
    model.addJoint(0, joint, pinocchio.SE3.Identity(), "ball")
    with pytest.raises(ValueError, match=rf"joint 'ball' of the type {joint.shortname()}"):
        load_robot(model)


@pytest.mark.parametrize("robot", [3, None, ["ur5"], object()])
def test_invalid_robot_type_raises(robot):
    with pytest.raises(TypeError, match=r"must be a name .*list_robots.*URDF or an MJCF file"):
        load_robot(robot)


@pytest.mark.parametrize("axis", [[0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.6, 0.80001], [0.0, 0.0, np.nan]])
@pytest.mark.parametrize("joint", [pinocchio.JointModelRevoluteUnaligned, pinocchio.JointModelPrismaticUnaligned])
def test_axis_of_another_length_raises(joint, axis):
    model = pinocchio.Model()
    model.addJoint(0, joint(np.array(axis)), pinocchio.SE3.Identity(), "long")
    with pytest.raises(
        ValueError, match=rf"joint 'long' with an axis of length {np.linalg.norm(axis):g}; it must be 1"
    ):
        load_robot(model)


def test_axis_of_a_table_is_checked():
    link = dataclasses.replace(get_system("pendulum").links[0], axis=(0.0, 2.0, 0.0))
    with pytest.raises(ValueError, match="The system 'mine' has the joint 'q' with an axis of length 2"):
        load_robot(System("mine", (link,)))


MIMIC = '<mimic joint="first" multiplier="2"/></joint><link name="of_second">'


@pytest.fixture
def mimicking(tmp_path):
    path = urdf(tmp_path / "mimic.urdf", [("first", "revolute", "1 0 0", 5), ("second", "revolute", "0 1 0", 5)])
    path.write_text(
        MIMIC.join(part.strip() for part in re.split(r'</joint>\s*<link name="of_second">', path.read_text()))
    )
    return path


def test_model_with_mimic_joints_raises(mimicking):
    model = pinocchio.buildModelFromUrdf(str(mimicking), mimic=True)
    with pytest.raises(ValueError, match=r"joint 'second' that mimics another; load the URDF with mimic=False"):
        load_robot(model)


def set_mass(model, mass):
    link = model.inertias[1]
    link.mass = mass


def set_placement(model, x):
    model.jointPlacements[1] = pinocchio.SE3(np.eye(3), np.array([x, 0.0, 0.0]))


def set_array(name):
    def change(model, value):
        array = np.array(getattr(model, name))
        array[0] = value
        setattr(model, name, array)

    return change


def set_gravity(model, value):
    model.gravity.linear = np.array([0.0, 0.0, value])


@pytest.mark.parametrize(
    ("change", "value", "message"),
    [
        (set_gravity, np.nan, "NaN or infinity in its gravity"),
        (set_gravity, -np.inf, "NaN or infinity in its gravity"),
        (set_mass, np.nan, "NaN or infinity in its inertias"),
        (set_mass, -1.0, "mass=-1 at the link that the joint '.*' moves"),
        (set_placement, np.inf, "NaN or infinity in its jointPlacements"),
        (set_array("damping"), np.nan, "NaN or infinity in its damping"),
        (set_array("damping"), -0.1, "damping=-0.1 at the joint"),
        (set_array("friction"), np.nan, "NaN or infinity in its friction"),
        (set_array("friction"), -0.1, "friction=-0.1 at the joint"),
        (set_array("armature"), -0.1, "armature=-0.1 at the joint"),
        (set_array("armature"), np.inf, "NaN or infinity in its armature"),
        (set_array("upperEffortLimit"), np.nan, "NaN in its upperEffortLimit"),
        (set_array("lowerEffortLimit"), np.nan, "NaN in its lowerEffortLimit"),
        (set_array("velocityLimit"), np.nan, "NaN in its velocityLimit"),
        (set_array("lowerPositionLimit"), np.nan, "NaN in its lowerPositionLimit"),
        (set_array("upperPositionLimit"), np.nan, "NaN in its upperPositionLimit"),
        (set_array("lowerEffortLimit"), 1.0, "motors that cannot give 0, such as that of the joint"),
        (set_array("upperEffortLimit"), -1.0, "motors that cannot give 0"),
    ],
)
@pytest.mark.parametrize("name", ["acrobot", "kinova"])
def test_invalid_model_numbers_raise(name, change, value, message):
    model = load_robot(name).copy()
    change(model, value)
    with pytest.raises(ValueError, match=rf"The model '{model.name}' has .*{message}"):
        load_robot(model)
