import itertools
import math
import pickle

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp import InverseDynamics
from skevgp.datasets import make_dynamics, simulate
from skevgp.exceptions import RobotModelWarning
from skevgp.features import InertiaForce, NominalDynamics, RigidBodyRegressor
from skevgp.robots import RigidBody, inertial_parameters, layout_of, load_robot, write_urdf

# An arm of a revolute and a prismatic joint, in both formats. Its base is on its side.
URDF = """
<robot name="arm">
  <link name="world"/><link name="base"/>
  <joint name="mount" type="fixed">
    <parent link="world"/><child link="base"/><origin xyz="0.1 0.2 0.3" rpy="1.5707963267948966 0 0"/>
  </joint>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-1" upper="2" effort="5" velocity="3"/><dynamics damping="0.3" friction="0.2"/>
  </joint>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0.2" rpy="0 0 0.5"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0.01" ixz="0.02" iyz="-0.03"/></inertial>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="upper"/><child link="lower"/><origin xyz="0 0.1 0.4" rpy="0 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-0.1" upper="0.2" effort="7" velocity="3"/>
  </joint>
  <link name="lower">
    <inertial><origin xyz="0 0.1 0"/><mass value="1.5"/>
      <inertia ixx="0.03" iyy="0.02" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
</robot>"""
MJCF = """
<mujoco model="arm">
  <compiler angle="radian" eulerseq="XYZ"/>
  <default>
    <joint damping="9" frictionloss="9"/>
    <default class="turns"><joint axis="0 3 4" range="-1 2" damping="0.3" frictionloss="0.2"/></default>
    <default class="slides"><joint type="slide" axis="1 0 0" damping="0" frictionloss="0"/></default>
  </default>
  <worldbody>
    <light pos="0 0 2"/><geom type="plane" size="1 1 1"/>
    <body name="table"><geom type="box" size="1 1 1"/></body>
    <body name="base" pos="0.1 0.2 0.3" euler="1.5707963267948966 0 0" childclass="slides">
      <body name="upper" pos="0 0 0.3" euler="0.1 0.2 0.3">
        <!-- A class replaces the child class. -->
        <joint name="shoulder" class="turns" actuatorfrcrange="-6 5"/>
        <inertial pos="0.1 0 0.2" axisangle="0 0 1 0.5" mass="2" fullinertia="0.1 0.2 0.15 0.01 0.02 -0.03"/>
        <body name="lower" pos="0 0.1 0.4">
          <joint name="slide" range="-0.1 0.2"/>
          <inertial pos="0 0.1 0" mass="1.5" diaginertia="0.03 0.02 0.04"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" forcerange="-5 5"/>
    <motor joint="slide" ctrlrange="-3.5 3.5" gear="2"/>
  </actuator>
</mujoco>"""


@pytest.fixture
def both(tmp_path):
    paths = tmp_path / "arm.urdf", tmp_path / "arm.xml"
    for path, text in zip(paths, (URDF, MJCF), strict=True):
        path.write_text(text)
    return paths


@pytest.fixture
def load(tmp_path):
    """Load a robot of a body or of the whole text of a file."""

    def loaded(body, head="", **given):
        text = body if body.startswith("<mujoco") else f"<mujoco>{head}<worldbody>{body}</worldbody></mujoco>"
        path = tmp_path / "robot.xml"
        path.write_text(text)
        return load_robot(path, **given)

    return loaded


def link(inside, joint='<joint name="a"/>', name="b"):
    return f'<body name="{name}">{joint}{inside}</body>'


BALL = '<inertial pos="0 0 0.5" mass="2" diaginertia="0.1 0.1 0.1"/>'


# --- the same arm ---------------------------------------------------------------------------------------------------


def test_arm_moves_as_that_of_its_urdf(both):
    urdf, mjcf = map(load_robot, both)
    assert list(mjcf.names) == list(urdf.names) == ["universe", "shoulder", "slide"]
    for name in ("damping", "friction", "armature", "upperEffortLimit", "lowerEffortLimit"):
        assert_array_equal(getattr(mjcf, name), getattr(urdf, name), name)
    for name in ("lowerPositionLimit", "upperPositionLimit"):
        assert_array_equal(getattr(mjcf, name), getattr(urdf, name), name)
    assert_allclose(inertial_parameters(mjcf), inertial_parameters(urdf), atol=1e-15)
    theirs, ours = RigidBody(urdf), RigidBody(mjcf)
    q, v, a = np.random.RandomState(0).randn(3, 20, 2)
    for row in q:
        assert_allclose(ours.mass_matrix(row), theirs.mass_matrix(row), rtol=1e-14)
    assert_allclose(ours.forces(q, v, a), theirs.forces(q, v, a), rtol=1e-12, atol=1e-13)
    assert_allclose(ours.gravity(q), theirs.gravity(q), rtol=1e-12, atol=1e-13)
    assert layout_of(mjcf) == layout_of(urdf)


def test_features_and_data_are_those_of_the_urdf(both):
    urdf, mjcf = both
    data = make_dynamics(mjcf, 3, n_steps=10, random_state=0)
    assert_allclose(make_dynamics(urdf, 3, n_steps=10, random_state=0).data, data.data, rtol=1e-9, atol=1e-12)
    for features in (InertiaForce, NominalDynamics, RigidBodyRegressor):
        rows = data.data if features is not RigidBodyRegressor else np.random.RandomState(1).randn(10, 6)
        ours, theirs = (features(robot).fit(rows).transform(rows) for robot in (mjcf, urdf))
        assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


def test_torques_are_learned(both):
    _, mjcf = both
    rng = np.random.RandomState(0)
    X = rng.uniform(-1.0, 1.0, (60, 6))
    y = RigidBody(load_robot(mjcf)).forces(*np.split(X, 3, axis=1)) + 0.01 * rng.randn(60, 2)
    model = InverseDynamics(mjcf, random_state=0).fit(X, y)
    assert model.score(X, y) > 0.99


def test_simple_arm_is_that_of_pinocchio(both, tmp_path):
    """Pinocchio reads what is left if the base is upright and first, and a class says all of its joint."""
    text = MJCF.replace(' euler="1.5707963267948966 0 0"', "").replace('<body name="table">', "<body>")
    text = text.replace('<body><geom type="box" size="1 1 1"/></body>', "").replace("XYZ", "xyz")
    text = text.replace('class="turns"><joint axis="0 3 4"', 'class="turns"><joint type="hinge" axis="0 0.6 0.8"')
    path = tmp_path / "simple.xml"
    path.write_text(text)
    theirs, ours = RigidBody(pinocchio.buildModelFromMJCF(str(path))), RigidBody(load_robot(path))
    q, v, a = np.random.RandomState(0).randn(3, 20, 2)
    assert_allclose(ours.forces(q, v, a), theirs.forces(q, v, a), rtol=1e-12, atol=1e-13)


def test_joints_can_be_locked(both):
    urdf, mjcf = (load_robot(path, joints=["shoulder"]) for path in both)
    assert_allclose(inertial_parameters(mjcf), inertial_parameters(urdf), atol=1e-15)


def test_robot_is_pickled(both):
    body = RigidBody(load_robot(both[1]))
    q = np.array([0.3, 0.1])
    assert_array_equal(pickle.loads(pickle.dumps(body)).mass_matrix(q), body.mass_matrix(q))


# --- elements -------------------------------------------------------------------------------------------------------


def test_gravity_and_armature(load):
    head = '<option gravity="0 0 -2"/>'
    robot = load(link(BALL, '<joint name="a" axis="0 1 0" armature="0.25"/>'), head)
    # m g l at 90 degrees; the moment of the ball is 0.1 + 2 0.5².
    assert_allclose(RigidBody(robot).gravity(np.array([[math.pi / 2]])), [[-2.0]])
    assert_allclose(RigidBody(robot).mass_matrix(np.zeros(1)), [[0.1 + 0.5 + 0.25]])
    still = load(link(BALL), '<option><flag gravity="disable"/></option>')
    assert_array_equal(still.gravity.linear, np.zeros(3))


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_position_in_the_pose_of_the_file_is_ref(load, kind):
    unit = math.pi / 180 if kind == "hinge" else 1.0
    bodies = [
        link(BALL, f'<joint name="a" type="{kind}" axis="0 1 0.2" pos="0.1 0.2 0" {ref}/>') for ref in ("", 'ref="0.4"')
    ]
    plain, shifted = (load(each) for each in bodies)
    poses = []
    for robot, q in ((plain, 0.5), (shifted, 0.5 + 0.4 * unit)):
        data = robot.createData()
        pinocchio.framesForwardKinematics(robot, data, np.array([q]))
        poses.append(data.oMf[robot.getFrameId("b")].homogeneous)
    assert_allclose(poses[0], poses[1], atol=1e-15)


def test_several_joints_of_a_body_are_a_chain(load):
    joints = (
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/><joint name="turn"/>'
    )
    robot = load(link('<inertial pos="0.5 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>', joints))
    # At q = 0, the body turns about its origin, at 0.5 m from its centre of mass.
    assert_allclose(RigidBody(robot).mass_matrix(np.zeros(3)), [[2, 0, 0], [0, 2, 1], [0, 1, 0.6]], atol=1e-15)


BOX = pinocchio.Inertia.FromBox
SHAPES = [
    ('type="box" size="0.1 0.2 0.3" mass="2"', BOX(2.0, 0.2, 0.4, 0.6)),
    ('type="box" size="0.1 0.2 0.3"', BOX(1000 * 0.2 * 0.4 * 0.6, 0.2, 0.4, 0.6)),
    ('type="box" size="0.1 0.2 0.3" density="10"', BOX(10 * 0.2 * 0.4 * 0.6, 0.2, 0.4, 0.6)),
    ('size="0.1" mass="2"', pinocchio.Inertia.FromSphere(2.0, 0.1)),
    ('type="ellipsoid" size="0.1 0.2 0.3" mass="2"', pinocchio.Inertia.FromEllipsoid(2.0, 0.1, 0.2, 0.3)),
    ('type="cylinder" size="0.1 0.2" mass="2"', pinocchio.Inertia.FromCylinder(2.0, 0.1, 0.4)),
    ('type="capsule" size="0.1 0.2" mass="2"', pinocchio.Inertia.FromCapsule(2.0, 0.1, 0.4)),
    ('type="capsule" fromto="0 0 -0.2 0 0 0.2" size="0.1" mass="2"', pinocchio.Inertia.FromCapsule(2.0, 0.1, 0.4)),
    ('type="box" fromto="0 0 -0.2 0 0 0.2" size="0.1" mass="2"', BOX(2.0, 0.2, 0.2, 0.4)),
]


@pytest.mark.parametrize(("shape", "inertia"), SHAPES, ids=[shape for shape, _ in SHAPES])
def test_body_without_inertial_has_that_of_its_shapes(load, shape, inertia):
    robot = load(link(f'<geom {shape}/><geom type="mesh" mesh="m" mass="0"/>'))
    assert_allclose(robot.inertias[1].toDynamicParameters(), inertia.toDynamicParameters(), rtol=1e-12, atol=1e-15)


def test_shapes_are_added_up_in_their_poses(load):
    robot = load(
        link(
            '<frame pos="0 0 1"><geom size="0.1" mass="2" pos="0.5 0 0"/></frame><geom size="0.1" mass="1" group="3"/>'
        ),
        '<compiler inertiagrouprange="0 2"/>',
    )
    assert_allclose(robot.inertias[1].mass, 2.0)
    assert_allclose(robot.inertias[1].lever, [0.5, 0.0, 1.0])


@pytest.mark.parametrize("rotation", [
    'quat="2 2 0 0"', 'axisangle="2 0 0 90"', 'euler="90 0 0"', 'xyaxes="1 0 0 0.3 0 1"', 'zaxis="0 -1 0"',
])  # fmt: skip
def test_orientations(load, rotation):
    robot = load(f'<body name="b" {rotation}><joint name="a"/>{BALL}</body>')
    assert_allclose(robot.jointPlacements[1].rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


@pytest.mark.parametrize("sequence", ["xyz", "XYZ", "zYx"])
def test_euler_angles_turn_about_the_axes_of_the_body_or_of_its_parent(load, sequence):
    angles = np.array([0.2, -0.3, 0.4])
    turns = dict.fromkeys("xyz", pinocchio.AngleAxis)
    expected = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        turn = turns[letter.lower()](angle, np.eye(3)["xyz".index(letter.lower())]).matrix()
        expected = expected @ turn if letter.islower() else turn @ expected
    text = " ".join(map(repr, angles.tolist()))
    robot = load(f'<body euler="{text}"><joint/>{BALL}</body>', f'<compiler angle="radian" eulerseq="{sequence}"/>')
    assert_allclose(robot.jointPlacements[1].rotation, expected, atol=1e-15)


def test_unnamed_bodies_and_joints_have_names(load):
    robot = load(f"<body><joint/>{BALL}<body><joint/><joint axis='1 0 0'/>{BALL}</body></body>")
    assert list(robot.names)[1:] == ["body1_joint", "body2_joint1", "body2_joint2"]


def test_limits_that_are_switched_off(load):
    body = link(BALL, '<joint name="a" range="-1 1"/>')
    for head, limited in (("", True), ('<compiler autolimits="false"/>', False)):
        assert np.isfinite(load(body, head).upperPositionLimit).all() == limited
    assert not np.isfinite(load(body.replace("range", 'limited="false" range')).upperPositionLimit).any()


def test_bounds_of_the_compiler(load):
    robot = load(
        link('<inertial pos="0 0 0" mass="0.001" diaginertia="1e-6 1 1"/>'),
        '<compiler boundmass="0.1" boundinertia="0.01"/>',
    )
    assert_allclose(np.diag(robot.inertias[1].inertia), [0.01, 1.0, 1.0])
    assert robot.inertias[1].mass == 0.1


# --- motors ---------------------------------------------------------------------------------------------------------

TWO = link(BALL + link(BALL, '<joint name="c" axis="1 0 0"/>', "d"), '<joint name="a"/>')


@pytest.mark.parametrize(
    ("actuators", "driven", "limits"),
    [
        ("", (0, 1), [np.inf, np.inf]),
        ('<motor joint="c" ctrlrange="-2 2" gear="-3"/>', (1,), [0.0, 6.0]),
        ('<position joint="a" ctrlrange="-2 2"/>', (0,), [np.inf, 0.0]),
        ('<general joint="a" forcerange="-2 2"/><motor joint="a" ctrlrange="-1 1"/>', (0,), [3.0, 0.0]),
        ('<motor tendon="t" forcerange="-4 4"/>', (0, 1), [2.0, 4.0]),
        ('<motor site="s" forcerange="-4 4"/>', (0, 1), [np.inf, np.inf]),
    ],
)
def test_joints_without_an_actuator_have_no_motor(load, actuators, driven, limits):
    tendon = '<tendon><fixed name="t"><joint joint="a" coef="0.5"/><joint joint="c" coef="-1"/></fixed></tendon>'
    robot = load(TWO, f"<actuator>{actuators}</actuator>{tendon}")
    assert layout_of(robot).driven == driven
    assert_array_equal(robot.upperEffortLimit, limits)
    assert_array_equal(robot.lowerEffortLimit, np.negative(limits))


def test_simulation_has_the_inputs_of_the_motors(load):
    robot = load(TWO, '<actuator><motor joint="c"/></actuator>')
    states = simulate(robot, np.zeros(4), np.zeros((5, 1)), 0.01)
    assert states.shape == (6, 4)


# --- other files, and errors ----------------------------------------------------------------------------------------


def test_scene_includes_a_robot(both, tmp_path):
    (tmp_path / "scene.xml").write_text(
        f'<mujoco><include file="{both[1].name}"/><worldbody><light/></worldbody></mujoco>'
    )
    ours, theirs = load_robot(tmp_path / "scene.xml"), load_robot(both[1])
    assert_array_equal(inertial_parameters(ours), inertial_parameters(theirs))


def test_files_that_include_each_other_raise(tmp_path):
    for one, other in itertools.permutations(("a.xml", "b.xml")):
        (tmp_path / one).write_text(f'<mujoco><include file="{other}"/></mujoco>')
    with pytest.raises(
        ValueError, match=r"a\.xml' is not an MJCF that can be read: it includes .* twice, or in itself"
    ):
        load_robot(tmp_path / "a.xml")


@pytest.mark.parametrize(
    ("body", "head", "message"),
    [
        (link(BALL, "<freejoint/>"), "", r"'b' has the joint 'b_joint' of the type 'free'; .* base fixed; delete"),
        (link(BALL, '<joint type="ball"/>'), "", r"of the type 'ball'; joints must be of the type hinge or slide"),
        (
            TWO,
            '<equality><connect body1="b" anchor="0 0 0"/></equality>',
            r"<connect> in <equality>, which closes a loop",
        ),
        (TWO, '<equality><weld body1="b"/></equality>', r"<weld> in <equality>, which closes a loop"),
        (
            link('<geom type="mesh" mesh="m"/>'),
            "",
            r"'b' has no <inertial>, and a geom of the type 'mesh'.*saveinertial",
        ),
        (link('<geom size="0.1" shellinertia="true"/>'), "", r"has no <inertial>, and a geom"),
        (
            '<replicate count="2"><body/></replicate>',
            "",
            r"the element <replicate>, which is not read here. MuJoCo can",
        ),
        (TWO, '<include file="none.xml"/>', r"it includes '.*none\.xml', which is not there"),
        (TWO, '<compiler settotalmass="3"/>', r"<compiler settotalmass='3'>, which is not read here"),
        (link('<inertial pos="0 0 0" mass="abc"/>'), "", r"mass of <inertial> of the body 'b' must be a finite number"),
        (link('<inertial pos="0 0" mass="1"/>'), "", r"pos of .* must be 3 finite numbers; it is '0 0'"),
        (
            link('<inertial pos="0 0 0" mass="-1"/>'),
            "",
            r"<inertial> of the body 'b' has mass=-1; it must be 0 or above",
        ),
        (link('<inertial mass="1"/>'), "", r"<inertial> of the body 'b' has no pos"),
        (link(BALL, '<joint name="a" axis="0 0 0"/>'), "", r"axis of the joint 'a' has no direction"),
        (link(BALL, '<joint name="a" range="1 -1"/>'), "", r"range='1 -1'; the second number must be the larger"),
        (link(BALL, '<joint name="a" limited="true"/>'), "", r"the joint 'a' has no range"),
        (link(BALL, '<joint name="a" class="x"/>'), "", r"<joint> has the class 'x', which is not in <default>"),
        (link(BALL) + link(BALL, '<joint name="c"/>'), "", r"it has 2 bodies of the name 'b'"),
        (link(BALL) + link(BALL, name="d"), "", r"it has 2 joints of the name 'a'"),
        (TWO, '<actuator><motor joint="e"/></actuator>', r"acts on the joint 'e', which is not there"),
        ("<frame><joint/></frame>", "", r"a <frame> has <joint>, which is not read there"),
        (TWO, "<default><default/></default>", r"a <default> in another one has no class"),
        (f'<body euler="1 2 3"><joint/>{BALL}</body>', '<compiler eulerseq="xy"/>', r"eulerseq='xy'; it must be three"),
    ],
)
def test_what_cannot_be_read_raises(load, body, head, message):
    with pytest.raises(ValueError, match=rf"robot\.xml' is not an MJCF that can be read: .*{message}"):
        load(body, head)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("<body/>", "has no joint that moves"),
        (link(BALL, '<joint name="a" damping="-1"/>'), "has damping=-1 at the joint 'a'"),
        (
            link('<inertial pos="0 0 0" mass="1" diaginertia="-1 1 1"/>', '<joint axis="1 0 0"/>'),
            "not positive definite",
        ),
    ],
)
def test_numbers_are_checked_as_those_of_a_urdf(load, body, message):
    with pytest.raises(ValueError, match=message):
        load(body)


def test_springs_and_compensated_weights_are_warned_of(load):
    body = link(BALL, '<joint name="a" stiffness="3"/>').replace('name="b"', 'name="b" gravcomp="1"')
    with pytest.warns(RobotModelWarning, match=r"'b' has gravcomp.*'a' has a spring \(stiffness\), which is not used"):
        load(body)


def test_inactive_loop_and_coupled_joints_are_read(load):
    equality = '<equality><weld body1="b" active="false"/><joint joint1="a" joint2="c"/></equality>'
    assert load(TWO, equality).nv == 2


def test_other_formats_raise(tmp_path):
    (tmp_path / "arm.sdf").write_text("<sdf/>")
    with pytest.raises(ValueError, match=r"is neither a URDF nor an MJCF: its root is <sdf>, not <robot> or <mujoco>"):
        load_robot(tmp_path / "arm.sdf")
    with pytest.raises(ValueError, match=r"There is no file '.*none\.xml'"):
        load_robot(tmp_path / "none.xml")


def test_urdf_cannot_be_written_from_it(both, tmp_path):
    with pytest.raises(
        ValueError, match=r"arm\.xml' is not a URDF that can be read: its root is <mujoco>, not <robot>"
    ):
        write_urdf(both[1], tmp_path / "new.urdf", inertial_parameters(load_robot(both[1])))
