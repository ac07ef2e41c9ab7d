"""Inertias that no body can have: an error if a mass matrix is not positive definite, else a warning."""

import warnings

import numpy as np
import pytest

from skevgp.datasets import make_dynamics
from skevgp.exceptions import RobotModelWarning
from skevgp.features import NominalDynamics, RigidBodyRegressor
from skevgp.robots import load_robot, perturb_robot

LINK = """<link name="{}"><inertial><origin xyz="0 0 -0.1"/><mass value="{mass}"/>
<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="j{}" type="continuous"><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/>
<origin xyz="0 0 -0.3"/></joint>"""


def arm(path, moments, mass=1.0):
    """Two links, of which the second one has these moments of inertia; both turn about y."""
    links = LINK.format("a", 0.01, 0.01, 0.01, mass=1.0) + LINK.format("b", *moments, mass=mass)
    path.write_text(
        f'<robot name="r"><link name="w"/>{links}{JOINT.format(1, "w", "a")}{JOINT.format(2, "a", "b")}</robot>'
    )
    return path


NOT_DEFINITE = (
    r"mass matrix that is not positive definite.*'b' of the joint 'j2' has 1 kg and moments .* of -1, -1, -1 kg"
)


@pytest.mark.parametrize(
    "use",
    [
        load_robot,
        lambda robot: NominalDynamics(robot).fit(np.zeros((2, 6))),
        lambda robot: RigidBodyRegressor(robot).coef_prior(2),
        lambda robot: make_dynamics(robot, 1),
        perturb_robot,
    ],
    ids=["load_robot", "NominalDynamics", "RigidBodyRegressor", "make_dynamics", "perturb_robot"],
)
def test_mass_matrix_that_is_not_positive_definite_is_refused_by_all_that_loads_a_robot(tmp_path, use):
    with pytest.raises(ValueError, match=NOT_DEFINITE):
        use(arm(tmp_path / "arm.urdf", (-1.0, -1.0, -1.0)))


def test_model_in_memory_is_checked_too(tmp_path):
    model = load_robot(arm(tmp_path / "arm.urdf", (0.01, 0.01, 0.01)))
    model.inertias[2].inertia = -np.eye(3)
    with pytest.raises(ValueError, match=r"The model 'r' has a mass matrix.*'b' of the joint 'j2' has 1 kg"):
        load_robot(model)
    unnamed = load_robot("acrobot").copy()
    unnamed.inertias[2].inertia = -np.eye(3)
    with pytest.raises(ValueError, match="that of the joint 'q2' has 1 kg"):
        load_robot(unnamed)
    model.armature = np.full(2, 2.0)  # of rotors: M = J + 2 1, with J above -2
    with pytest.warns(RobotModelWarning, match="No mass matrix has a negative eigenvalue in 300 configurations"):
        load_robot(model)


@pytest.mark.parametrize(
    ("moments", "mass", "told"),
    [
        ((-0.001, 0.01, 0.01), 1.0, "1 kg and moments .* of -0.001, 0.01, 0.01 kg"),  # about an axis that stays still
        ((0.01, 0.01, 0.04), 1.0, "1 kg and moments .* of 0.01, 0.01, 0.04 kg"),
        ((0.01, 0.01, 0.01), 0.0, "0 kg and moments .* of 0.01, 0.01, 0.01 kg"),
    ],
    ids=["negative", "triangle", "massless"],
)
def test_unphysical_inertia_warns(tmp_path, moments, mass, told):
    path = arm(tmp_path / "arm.urdf", moments, mass)
    with pytest.warns(RobotModelWarning, match=rf"'b' of the joint 'j2' has {told}.*triangle inequality.*write_urdf"):
        model = load_robot(path)
    with pytest.warns(RobotModelWarning, match="triangle inequality"):
        load_robot(model)
    weld = '<joint name="w" type="fixed"><parent link="b"/><child link="c"/></joint><link name="c"/></robot>'
    path.write_text(path.read_text().replace("</robot>", weld))
    with pytest.warns(RobotModelWarning, match=rf"'b' of the joint 'j2', with what is fixed to it \('c'\), has {told}"):
        load_robot(path)


@pytest.mark.parametrize(
    "moments",
    [(0.0, 0.0, 0.0), (0.02, 0.02, 0.0), (0.01, 0.01, 0.02), (0.00123, 0.00123, 0.00247), (1e-19, -1e-19, -1e-19)],
    ids=["point", "rod", "disk", "rounded disk", "rounding"],
)
def test_point_a_rod_a_disk_and_what_files_round_are_bodies(tmp_path, moments):
    load_robot(arm(tmp_path / "arm.urdf", moments))


@pytest.mark.parametrize(
    ("moments", "impossible"),
    [
        (("0.001", "0.001", "0.003"), False),  # such as 0.00149, 0.00149, 0.00251
        (("0.0010", "0.0010", "0.0030"), True),
        (("1e-3", "1e-3", "3e-3"), False),
        (("0", "0", "0.001"), False),
        (("0.0", "0.0", "0.0010"), True),
        (("0.0", "0.0", "0.1234"), True),
        (("0.001", "0.001", "0.004"), True),
        (("-0.001", "0.010", "0.010"), True),
        (("0.001000", "0.00100", "0.00201"), False),
    ],
)
def test_violation_below_the_rounding_of_the_digits_is_not_warned_of(tmp_path, moments, impossible):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_robot(arm(tmp_path / "arm.urdf", moments))
    assert len(caught) == impossible
