"""Every robot of `list_robots` in every map, prior and simulation: it works without a warning, or is refused."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from skevgp.datasets import list_robots, load_robot, make_dynamics
from skevgp.features import (
    AngleEncoder,
    Friction,
    InertiaForce,
    InertiaForceGravity,
    LinkGravity,
    NominalDynamics,
    RigidBodyRegressor,
)
from skevgp.robots import layout_of

# Joints that move no mass, some of them.
MASSLESS = {
    "bluevolta_bravo7_gripper": "bravo_finger1_joint",
    "bravo7_gripper": "bravo_finger1_joint",
    "falcon_bravo7_gripper": "bravo_finger1_joint",
    "romeo": "LHand",
    "romeo_laas_small": "l_gripper_joint",
}
# Prismatic and continuous joints, fingers, and joints that move no mass.
QUICK = ("pendulum", "acrobot", "ur5", "panda", "double_pendulum_continuous", "falcon_bravo7_gripper")


def marked(name):
    return name if name in QUICK else pytest.param(name, marks=pytest.mark.long)


def uses(robot):
    """(name, what is made of the robot)."""
    model = load_robot(robot)
    layout, n = layout_of(model), model.nv
    rng = np.random.default_rng(0)
    rows, torque_rows = rng.uniform(-1.0, 1.0, (1, layout.n_columns)), rng.uniform(-1.0, 1.0, (1, 3 * n))

    def prior_of(feature_map, n_outputs):
        """Mean and standard deviations, for data of size 1. Each is either the map's own or in units of the data."""
        if not hasattr(feature_map, "coef_prior"):
            return []
        mean, own = feature_map.coef_prior(n_outputs)
        if not hasattr(feature_map, "coef_scale"):
            return [mean, own]
        in_units = feature_map.coef_scale(np.ones(n_outputs), np.ones(mean.shape[1]))
        assert_array_equal(np.isnan(in_units), ~np.isnan(own))
        assert feature_map.coef_groups(n_outputs).shape == mean.shape
        return [mean, np.where(np.isnan(own), in_units, own)]

    def mapped(feature_map, X, n_outputs=2 * n):
        before = prior_of(feature_map, n_outputs)
        H = feature_map.fit_transform(X)
        assert len(feature_map.get_feature_names_out()) == H.shape[-1]
        assert_array_equal(pickle.loads(pickle.dumps(feature_map)).transform(X), H)
        return [H, feature_map.jacobian(X), *before, *prior_of(feature_map, n_outputs)]

    terms = ["acceleration", "gravity", "bias", "input"]
    return {
        "AngleEncoder": lambda: mapped(AngleEncoder(model), rows),
        "Friction": lambda: mapped(Friction(model), rows),
        "InertiaForce": lambda: mapped(InertiaForce(model), rows),
        "InertiaForceGravity": lambda: mapped(InertiaForceGravity(model), rows),
        "LinkGravity": lambda: mapped(LinkGravity(model), rows),
        "NominalDynamics": lambda: mapped(NominalDynamics(model, terms=terms), rows),
        "RigidBodyRegressor": lambda: mapped(RigidBodyRegressor(model), torque_rows, n),
        "make_dynamics": lambda: make_dynamics(model, 1, 2, dt=0.001, random_state=0, return_X_y=True),
    }


@pytest.mark.filterwarnings("ignore::skevgp.exceptions.RobotModelWarning")  # of three: tests/robots/test_loading.py
@pytest.mark.parametrize("name", [marked(name) for name in list_robots()])
def test_robot_works_in_all_maps_and_simulation(name):
    for use, values in uses(name).items():
        if name in MASSLESS and use in ("NominalDynamics", "make_dynamics"):
            with pytest.raises(
                ValueError, match=rf"not finite: its joints.*{MASSLESS[name]}|singular.*{MASSLESS[name]}"
            ):
                values()
        else:
            assert all(np.isfinite(value).all() for value in values()), use
