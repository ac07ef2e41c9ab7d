"""What of a URDF file Pinocchio is given; `tests/properties/test_nasty_data.py` damages such files."""

import warnings
from itertools import pairwise

import numpy as np
import pinocchio
import pytest
from numpy.testing import assert_array_equal

from skevgp.exceptions import RobotModelWarning
from skevgp.features import RigidBodyRegressor
from skevgp.robots import layout_of, load_robot
from skevgp.robots.loading import _collection, effort_limits
from skevgp.robots.urdf_file import checked_urdf

from .test_urdf import ARM, BOMB

LINK = '<link name="{}"/>'
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<limit effort="1" velocity="1"/></joint>"""


def joint(parent, child, kind="revolute", name=None):
    return JOINT.format(parent=parent, child=child, kind=kind, name=name or f"to_{child}")


def robot(links, *joints):
    return f'<robot name="r">{"".join(map(LINK.format, links))}{"".join(joints)}</robot>'


@pytest.fixture
def load(tmp_path):
    def load(text):
        path = tmp_path / "arm.urdf"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load_robot(path)

    return load


@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.long)])
def test_parsed_urdf_equals_pinocchio(every):
    for path in list(_collection().values())[::every]:
        assert pinocchio.buildModelFromXML(checked_urdf(path).text) == pinocchio.buildModelFromUrdf(str(path)), path


def test_nothing_but_the_tree_and_its_numbers_is_handed_over(tmp_path):
    path = tmp_path / "arm.urdf"
    mesh = '<visual><geometry><mesh filename="package://../../etc/passwd"/></geometry></visual>'
    path.write_text(ARM.replace('<link name="lower"/>', f'<link name="lower">{mesh}</link>'))
    text = checked_urdf(path).text
    assert not any(word in text for word in ("mesh", "passwd", "visual", "transmission", "colour", "<!--"))
    assert pinocchio.buildModelFromXML(text) == pinocchio.buildModelFromUrdf(str(path))


@pytest.mark.parametrize("kind", ["fixed", "revolute"])
def test_world_need_not_be_declared(load, kind):
    """As Drake has it."""
    joints = joint("world", "a", kind), joint("a", "b")
    assert load(robot("ab", *joints)) == load(robot(["world", "a", "b"], *joints))
    with pytest.raises(ValueError, match="the joint 'to_world' has the child link 'world', which is not there"):
        load(robot("ab", joint("a", "b"), joint("b", "world", kind)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'mass value="2"',
            'mass value="nan"',
            r"value of <mass> of <link name='upper'> must be a finite number; it is",
        ),
        ('mass value="2"', 'mass value="1e999"', "must be a finite number; it is '1e999'"),
        ('mass value="2"', 'mass value="0x10"', "must be a finite number"),
        ('mass value="2"', 'mass value="1_0"', "must be a finite number"),
        ('mass value="2"', 'mass value="٣"', "must be a finite number"),
        ('<mass value="2"/>', "<mass/>", "<mass> of <link name='upper'> has no value"),
        ('<mass value="2"/>', "", "<inertial> of <link name='upper'> has no mass"),
        ('ixx="0.1" ixy="0.01"', 'ixx="0.1"', "<inertia> of <link name='upper'> has no ixy"),
        ('xyz="0 0 0.3"', 'xyz="0 0"', "xyz of <origin> of <joint name='one'> must be 3 finite numbers; it is '0 0'"),
        ('xyz="0 0 0.3"', 'xyz="0 0 inf"', "must be 3 finite numbers"),
        ('damping="0.5"', 'damping=""', "damping of <dynamics> of <joint name='one'> must be a finite number"),
        ('effort="3" velocity="4"', 'velocity="4"', "<limit> of <joint name='one'> has no effort"),
        (
            'type="prismatic"',
            'type="spherical"',
            "the joint 'two' is of the type 'spherical', which is none of revolute",
        ),
        ('type="prismatic"', "", "<joint name='two'> has no type"),
        (
            '<child link="point"/>',
            '<child link="none"/>',
            "the joint 'tip' has the child link 'none', which is not there",
        ),
        ('<child link="point"/>', '<child link="pont"/>', "link 'pont', which is not there; did you mean 'point'?"),
        (
            'damping="0.5"',
            'damping="-0.5"',
            "the joint 'one' has <dynamics damping=\"-0.5\">; damping must be 0 or above",
        ),
        ('friction="0.25"', 'friction="-0.39"', "'one' has <dynamics friction=\"-0.39\">; friction must be 0 or above"),
        ('damping="0.5"', 'damping="${d}"', "damping of <dynamics> of <joint name='one'> must be a finite number"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 -0"/>', '<axis xyz="0 0 -0">, which has no direction'),
        (
            '<link name="point"/>',
            '<xacro:link name="point"/>',
            "the element <xacro:link> of xacro.*expand the file first",
        ),
        ('<child link="point"/>', "<child/>", "<child> of <joint name='tip'> has no link"),
        ('<child link="point"/>', "", "<joint name='tip'> has no child"),
        ('<link name="point"/>', '<link name="base"/>', "two links of the name 'base'"),
        ('<joint name="tip"', '<joint name="one"', "two joints of the name 'one'"),
        ('<child link="point"/>', '<child link="upper"/>', "the link 'upper' is the child of two joints"),
        ('<link name="point"/>', '<link name="point"/><link name="far"/>', "2 links that are no joint's child"),
        ('<robot name="arm"', "<robot", "<robot> has no name"),
    ],
)
def test_missing_or_invalid_number_raises(load, old, new, message):
    """Pinocchio itself would take a mass that is no number for 0."""
    assert old in ARM
    with pytest.raises(ValueError, match=rf"arm\.urdf' is not a URDF that can be read: .*{message}"):
        load(ARM.replace(old, new, 1))


def test_links_in_a_circle_raise(load):
    """Pinocchio leaves them out, and makes a robot of the rest."""
    with pytest.raises(ValueError, match=r"it has links in a circle: \['c', 'd'\]"):
        load(robot("abcd", joint("a", "b"), joint("c", "d"), joint("d", "c")))


def test_joint_without_limits_raises(load):
    text = robot("ab", joint("a", "b")).replace('<limit effort="1" velocity="1"/>', "")
    with pytest.raises(ValueError, match="the joint 'to_b' has no <limit>, which a revolute one needs"):
        load(text)
    assert load(text.replace("revolute", "continuous")).nv == 1


def test_too_long_chain_raises(load):
    """Pinocchio goes from joint to joint by recursion: one of 5000 ends the interpreter."""

    def chain(n, kind):
        names = [f"l{i}" for i in range(n)]
        return robot(names, *[joint(*pair, kind) for pair in pairwise(names)])

    assert load(chain(301, "revolute")).nv == 300
    with pytest.raises(ValueError, match="it has 501 links in a row, more than 500"):
        load(chain(501, "fixed"))
    with pytest.raises(ValueError, match="it has 301 joints that move, more than 300"):
        load(robot(["base", *map(str, range(301))], *[joint("base", str(i)) for i in range(301)]))


def test_deeply_nested_urdf_raises(load):
    """Writing goes from element to element by recursion."""
    with pytest.raises(ValueError, match="it has elements more than 100 deep in each other"):
        load(b'<robot name="r">' + b"<x>" * 101 + b"</x>" * 101 + b"</robot>")


@pytest.mark.parametrize(
    "declared",
    [f'<!DOCTYPE robot [<!ENTITY a0 "ha">{BOMB}]>', '<!DOCTYPE robot [<!ENTITY a12 SYSTEM "file:///etc/passwd">]>'],
    ids=["bomb", "external"],
)
def test_entities_are_not_read(load, declared):
    text = robot(["&a12;", "b"], joint("&a12;", "b"))
    with pytest.raises(ValueError, match="it has a document type declaration, which is not read"):
        load(declared + text)


def warned(load, text):
    """The model, and what is warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = load(text)
    assert all(one.category is RobotModelWarning for one in caught)
    return model, [str(one.message) for one in caught]


def test_negative_limit_of_effort_is_unknown(load):
    """A limit of 0 would be a joint without a motor."""
    model, messages = warned(
        load, robot("abc", joint("a", "b"), joint("b", "c")).replace('"1" velocity', '"-5" velocity', 1)
    )
    assert len(messages) == 1
    assert "The joint 'to_b' has <limit effort=\"-5\">; a limit of effort must be 0 or above" in messages[0]
    assert_array_equal(effort_limits(model), [[-np.inf, -1.0], [np.inf, 1.0]])
    assert layout_of(model).driven == (0, 1)
    assert np.isfinite(RigidBodyRegressor(model).coef_prior(2)[1]).all()


def test_file_is_warned_of_once(load):
    names = [f"l{number}" for number in range(8)]
    text = robot(names, *map(joint, names[:-1], names[1:])).replace('effort="1"', 'effort="-1"')
    (message,) = warned(load, text)[1]
    assert message.count("is not used") == 4
    assert message.endswith("(3 more are like these.)")


BODY = """<link name="{}"><inertial><mass value="{}"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def test_negative_mass_is_warned_of_as_a_part_and_refused_as_a_body(load):
    text = f'<robot name="r"><link name="a"/>{BODY.format("b", 2)}{BODY.format("c", -0.5)}{joint("a", "b")}{{}}</robot>'
    model, messages = warned(load, text.format(joint("b", "c", "fixed")))
    assert "The link 'c' has <mass value=\"-0.5\">" in messages[0]
    assert model.inertias[1].mass == 1.5
    light = f"{BODY.format('d', 0)}{BODY.format('e', 0.5)}{joint('b', 'd')}{joint('d', 'e', 'fixed')}"
    assert warned(load, text.format(joint("b", "c", "fixed") + light))[0].inertias[2].mass == 0.5
    with pytest.raises(ValueError, match="mass=-0.5 at the link that the joint 'to_c' moves; it must be 0 or above"):
        load(text.format(joint("b", "c")))


@pytest.mark.parametrize("masses", [(2, -2), (2, -2, 3), (-0.5, 2), (2, -2.5, 3), (0.3, -0.1, -0.2)])
def test_negative_masses_that_pinocchio_cannot_add_raise(load, masses):
    """It divides by the sum after each link, and by some 1e-16 in place of a sum of 0."""
    bodies = "".join(BODY.format(link, mass) for link, mass in zip("bcd", masses, strict=False))
    welds = "".join(joint("b", link, "fixed") for link, _ in zip("cd", masses[1:], strict=False))
    with pytest.raises(ValueError, match=r"the link '.' has <mass value=\"-.*first of them, 'b', which is"):
        load(f'<robot name="r"><link name="a"/>{bodies}{joint("a", "b")}{welds}</robot>')
