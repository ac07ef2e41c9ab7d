import re
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from skevgp.robots import inertial_parameters, load_robot, physical_consistency, write_urdf
from skevgp.robots.loading import robot_file

# The large files are long.
ROBOTS = ["panda", "ur10", "kinova", "double_pendulum_continuous", "xarm7"]
ROBOTS += [pytest.param(name, marks=pytest.mark.long) for name in ("talos_left_arm", "tiago", "baxter")]

# A base with a welded foot, two moving bodies, one with a tool welded to it at an angle, another on that.
ARM = """<?xml version="1.0"?>
<!-- Copyright: the licence stands here -->
<robot name="arm" xmlns:tool="http://tool.example/">
  <link name="base">
    <inertial><mass value="4"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  </link>
  <link name="foot">
    <inertial><mass value="3"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  </link>
  <joint name="weld" type="fixed"><parent link="base"/><child link="foot"/></joint>
  <joint name="one" type="revolute">
    <parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="2" effort="3" velocity="4"/>
    <dynamics damping="0.5" tool:note="a &lt; b" friction="0.25"/>
  </joint>
  <link name="upper">
    <!-- measured -->
    <inertial>
      <origin xyz="0.1 0 0.2" rpy="0.3 0.4 0.5"/>
      <mass value="2"/>
      <inertia ixx="0.1" ixy="0.01" ixz="0" iyy="0.2" iyz="0" izz="0.15"/>
    </inertial>
    <visual tool:colour='red > green'><geometry><sphere radius="1"/></geometry></visual>
  </link>
  <joint name="two" type="prismatic">
    <parent link="upper"/><child link="lower"/>
    <origin xyz="0.5 0 0" rpy="0 1 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="3" velocity="4"/>
  </joint>
  <link name="lower"/>
  <joint name="flange" type="fixed">
    <parent link="lower"/><child link="too--l"/><origin xyz="1 2 3" rpy="1 2 3"/>
  </joint>
  <link name="too--l">
    <inertial>
      <mass value="1.5"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial>
  </link>
  <joint name="tip" type="fixed"><parent link="too--l"/><child link="point"/></joint>
  <link name="point"/>
  <transmission name="t"><joint name="one"><inertial>not a link's</inertial></joint></transmission>
</robot>
<!-- the end -->
"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def other_parameters(model, seed=0):
    """Parameters of some body for each link."""
    factors = np.random.default_rng(seed).normal(size=(model.nv, 3, 3))
    links = [
        pinocchio.Inertia(m, lever, np.trace(s) * np.eye(3) - s)
        for m, lever, s in zip(
            1.0 + np.arange(model.nv), factors[:, 0], factors @ factors.swapaxes(1, 2) + 0.1 * np.eye(3), strict=True
        )
    ]
    return np.array([link.toDynamicParameters() for link in links])


@pytest.mark.parametrize("name", ROBOTS)
def test_written_urdf_is_read_by_pinocchio(name, tmp_path):
    model, target = load_robot(name), tmp_path / "new.urdf"
    expected = other_parameters(model)
    friction = np.linspace(0.0, 1.0, model.nv)
    write_urdf(name, target, expected, covariance=np.eye(expected.size), damping=0.3, friction=friction)
    raw, written = pinocchio.buildModelFromUrdf(str(target)), load_robot(target)
    assert_allclose([link.toDynamicParameters() for link in raw.inertias[1:]], expected, rtol=1e-9, atol=1e-9)
    assert_array_equal(written.damping, np.full(model.nv, 0.3))
    assert_array_equal(written.friction, friction)
    assert list(written.names) == list(model.names)
    assert written.inertias[0] == model.inertias[0]
    assert list(written.jointPlacements) == list(model.jointPlacements)
    assert_array_equal(written.upperPositionLimit, model.upperPositionLimit)


@pytest.mark.parametrize("name", ROBOTS)
def test_nothing_else_of_a_file_changes(name, tmp_path):
    model, target = load_robot(name), tmp_path / "new.urdf"
    write_urdf(name, target, other_parameters(model))
    texts = [path.read_text(encoding="utf-8") for path in (robot_file(name), target)]
    inertials = r"<inertial\s*>.*?</inertial>|<inertial\s*/>|<!-- The inertia of this link is part of that of .*? -->"
    old, new = (re.sub(inertials, "", text, flags=re.S) for text in texts)
    assert ET.canonicalize(old, strip_text=True, with_comments=True) == ET.canonicalize(
        new, strip_text=True, with_comments=True
    )
    assert texts[0] != texts[1]


def test_comments_and_prefixes_are_kept_and_inertials_replaced(arm, tmp_path):
    target = tmp_path / "new.urdf"
    body = [2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    write_urdf(arm, target, [body, body])
    lines = [
        "<inertial>",
        '  <origin xyz="0.0 0.0 0.0" rpy="0 0 0" />',
        '  <mass value="2.0" />',
        '  <inertia ixx="1.0" ixy="0.0" iyy="1.0" ixz="0.0" iyz="0.0" izz="1.0" />',
        "</inertial>",
    ]
    written, text = "\n    ".join(lines), target.read_text()
    assert text.startswith(
        '<?xml version="1.0" encoding="utf-8"?>\n<!-- Copyright: the licence stands here -->\n<robot name="arm" '
        'xmlns:tool="http://tool.example/">\n  <link name="base">'
    )
    assert text.endswith("</robot>\n<!-- the end -->\n")
    assert f'<link name="upper">\n    <!-- measured -->\n    {written}\n    <visual tool:col' in text
    assert 'tool:colour="red &gt; green">' in text
    assert f'<link name="lower">\n    {written}\n  </link>' in text
    assert "<!-- The inertia of this link is part of that of lower. -->" in text
    assert text.count("<mass") == 4


def test_standard_deviations_are_those_of_mass_centre_and_inertia(arm, tmp_path):
    """By drawing parameters, and computing what is written from each draw."""
    parameters, rng = other_parameters(load_robot(arm)), np.random.default_rng(0)
    factor = rng.normal(size=(20, 20)) * 1e-4
    target = tmp_path / "new.urdf"
    write_urdf(arm, target, parameters, covariance=factor @ factor.T)
    draws = parameters + (rng.normal(size=(10000, 20)) @ factor.T).reshape(-1, 2, 10)
    for index, comment in enumerate(re.findall(r"<!-- standard deviations: mass=(.*?) -->", target.read_text())):
        links = [pinocchio.Inertia.FromDynamicParameters(draw) for draw in draws[:, index]]
        entries = [np.r_[x.mass, x.lever, x.inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]] for x in links]
        written = [float(number) for number in re.findall(r"[-\d.e]*\d", comment)]
        assert_allclose(written, np.std(entries, axis=0), rtol=0.03)
    assert index == 1


# --- refusals ------------------------------------------------------------------------------------------------------


def test_source_is_overwritten_only_if_that_is_said(arm, tmp_path):
    parameters, link = other_parameters(load_robot(arm)), tmp_path / "link.urdf"
    link.symlink_to(arm)
    for target in (arm, str(arm), link):
        with pytest.raises(ValueError, match=r"arm\.urdf' is the source; overwrite=True"):
            write_urdf(arm, target, parameters)
    assert arm.read_text() == ARM
    write_urdf(arm, arm, parameters, overwrite=True)
    assert_allclose(inertial_parameters(load_robot(arm)), parameters, atol=1e-9)


BOMB = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(12))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            f'<!DOCTYPE robot [<!ENTITY a0 "ha">{BOMB}]>{ARM.partition("?>")[2]}'.replace("measured", "&a12;"),
            "entities",
        ),
        ('<!DOCTYPE robot SYSTEM "other.dtd"><robot name="a"/>', "document type declaration"),
        ('<robot name="&secret;"/>', "undefined entity"),
        ("<sdf/>", "its root is <sdf>, not <robot>"),
        ("<robot", "unclosed token"),
        ("", "no element found"),
        ("\0\1\2", "not well-formed"),
        (b'<?xml version="1.0" encoding="nonsense"?><robot name="a"/>', "unknown encoding"),
    ],
    ids=["bomb", "dtd", "entity", "sdf", "unclosed", "empty", "binary", "encoding"],
)
def test_invalid_urdf_raises(content, message, tmp_path):
    source, target = tmp_path / "wrong.urdf", tmp_path / "new.urdf"
    source.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=rf"wrong\.urdf' is not a URDF that can be read: .*{message}"):
        write_urdf(source, target, np.ones((2, 10)))
    assert not target.exists()


def test_file_without_joints_that_move_raises(tmp_path):
    (tmp_path / "stone.urdf").write_text('<robot name="stone"><link name="a"/></robot>')
    with pytest.raises(ValueError, match=r"stone\.urdf' has no joint that moves"):
        write_urdf(tmp_path / "stone.urdf", tmp_path / "new.urdf", np.ones((1, 10)))


@pytest.mark.parametrize("source", ["acrobot", load_robot("ur10"), 3], ids=["system", "model", "number"])
def test_robot_without_a_file_raises(source, tmp_path):
    with pytest.raises(ValueError, match="source must be a URDF file, or the name of a robot that has one; got"):
        write_urdf(source, tmp_path / "new.urdf", np.ones((2, 10)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"parameters": np.ones((3, 10))}, r"parameters must have the shape .* = \(2, 10\)"),
        ({"parameters": -np.ones((2, 10))}, "No body can have .* that the joint 'one' moves"),
        ({"covariance": np.eye(10)}, r"covariance must have the shape .* = \(20, 20\)"),
        ({"damping": -1.0}, "damping must be finite and not negative"),
        ({"friction_std": np.ones(3)}, "friction_std must be a number or have the shape"),
    ],
)
def test_invalid_arguments_write_nothing(changed, message, arm, tmp_path):
    target, parameters = tmp_path / "new.urdf", other_parameters(load_robot(arm))
    assert (physical_consistency(parameters) > 0.0).all()
    with pytest.raises(ValueError, match=message):
        write_urdf(arm, target, **{"parameters": parameters, **changed})
    assert not target.exists()
