"""The identified robot: the inertias of its links, a model and a URDF file with these, and its payload."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import Bunch
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from ..robots import body_parameters, layout_of, nearest_consistent, physical_consistency, with_parameters, write_urdf
from ..utils.validation import check_integer, check_magnitude, check_real, validate_numbers
from .joint_residual import JointResidual
from .moves import EFFECTS, terms
from .payload import find_payload, payload_prior
from .torque_regression import TorqueRegression
from .weights import Known

# Largest prior scale of the mass (kg) and size (m) of a payload.
_LARGEST_SCALE = 1e6


def _knows_a_robot(model: IdentifiedRobot) -> bool:
    if not hasattr(model, "feature_map_") or model._has_robot:
        return True
    raise AttributeError("This method needs a robot. Pass robot to InverseDynamics.")


class IdentifiedRobot(TorqueRegression):
    """Methods of `InverseDynamics` for the identified robot."""

    _known: Known
    _joints: list[JointResidual]
    _outputs: list[str]
    coef_: np.ndarray
    coef_std_: np.ndarray
    coef_cov_: np.ndarray
    gains_: np.ndarray

    @available_if(_knows_a_robot)
    def links(self) -> list[Bunch]:
        """Return the inertial parameters of each link with their standard deviations.

        Returns
        -------
        links : list of Bunch
            Links from the base to the tip. Each has these values in the frame of its joint:

            - ``joint`` : name of the joint;
            - ``mass``, ``mass_std`` : mass, kg;
            - ``com``, ``com_std`` : ndarray of shape (3,), centre of mass, m;
            - ``inertia``, ``inertia_std`` : ndarray of shape (6,), moments of inertia Ixx, Ixy, Iyy, Ixz, Iyz, Izz
              about the centre of mass, kg m²;
            - ``consistency`` : above 0 if the parameters are physical (`robot_model` takes the nearest physical ones).

            Standard deviations are to first order. Torques determine only combinations of the parameters. So many
            standard deviations are those of the prior.

        References
        ----------
        - P. M. Wensing, S. Kim, J.-J. E. Slotine (2017): Linear Matrix Inequalities for Physically-Consistent Inertial
          Parameter Identification.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import InverseDynamics
        >>> X = np.random.default_rng(0).normal(size=(300, 3))
        >>> y = 1.2 * (X[:, 2] / 4 + 9.81 / 2 * np.sin(X[:, 0]))  # 1.2 kg instead of 1 kg in the model
        >>> (link,) = InverseDynamics("pendulum", n_inducing=0).fit(X, y).links()
        >>> link.joint, float(round(link.mass * -link.com[2], 2))  # the torque of gravity depends on m c
        ('q', 0.6)
        """
        check_is_fitted(self)
        parameters, covariance = self._inertial()
        values, slopes = body_parameters(parameters)
        consistency = physical_consistency(parameters)
        found = []
        for number, (joint, value, slope) in enumerate(zip(self._outputs, values, slopes, strict=True)):
            of = slice(10 * number, 10 * number + 10)
            std = np.sqrt(np.maximum(np.diag(slope @ covariance[of, of] @ slope.T), 0.0))
            found.append(
                Bunch(
                    joint=joint,
                    mass=float(value[0]),
                    mass_std=float(std[0]),
                    com=value[1:4],
                    com_std=std[1:4],
                    inertia=value[4:],
                    inertia_std=std[4:],
                    consistency=float(consistency[number]),
                )
            )
        return found

    @available_if(_knows_a_robot)
    def robot_model(self) -> Any:
        """Return a Pinocchio model of the identified robot.

        Returns
        -------
        model : pinocchio.Model
            Copy of the robot's model with the most probable physical inertias, armatures, ``damping`` and
            ``friction``. Negative damping and friction are set to 0. The copy has no offsets, no f_j and no ``gains_``.

        Raises
        ------
        ImportError
            If Pinocchio is not installed.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import InverseDynamics
        >>> X = np.random.default_rng(0).normal(size=(300, 3))
        >>> y = X[:, 2] / 4 + 9.81 / 2 * np.sin(X[:, 0]) + 0.7 * X[:, 1]
        >>> InverseDynamics("pendulum", n_inducing=0).fit(X, y).robot_model().damping.round(2)
        array([0.7])
        """
        check_is_fitted(self)
        friction = {name: np.maximum(values, 0.0) for name, values in self._friction(self.coef_).items()}
        return with_parameters(
            self.feature_map_.model_,
            nearest_consistent(*self._inertial()),
            armature=friction.get("armature"),
            damping=friction.get("viscous"),
            friction=friction.get("coulomb"),
        )

    @available_if(_knows_a_robot)
    def write_urdf(self, target: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the robot's URDF file with the identified parameters, and with standard deviations as comments.

        Parameters
        ----------
        target : str or path-like
            File to write.
        overwrite : bool, default=False
            Whether the target may be the file that the robot was loaded from.

        Raises
        ------
        ValueError
            If the robot has no file, or its file cannot be rewritten, or the file has other joints than in `fit`.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from skevgp import InverseDynamics
        >>> from skevgp.features import RigidBodyRegressor
        >>> X, body = np.random.default_rng(0).normal(size=(100, 18)), RigidBodyRegressor("ur5")
        >>> y = body.fit_transform(X) @ body.coef_prior(6)[0]
        >>> model = InverseDynamics("ur5", n_inducing=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     model.fit(X, y).write_urdf(Path(folder) / "found.urdf")
        ...     "standard deviations: mass=" in (Path(folder) / "found.urdf").read_text(encoding="utf-8")
        True
        """
        check_is_fitted(self)
        joints = layout_of(self.feature_map_.robot).position_names
        if list(joints) != self._outputs:
            raise ValueError(f"The robot's file must have the joints of the fit, {self._outputs}; got {list(joints)}.")
        parameters, covariance = self._inertial()
        friction, std = self._friction(self.coef_), self._friction(self.coef_std_)
        write_urdf(
            self.feature_map_.robot,
            target,
            nearest_consistent(parameters, covariance),
            covariance=covariance,
            damping=np.maximum(friction["viscous"], 0.0) if "viscous" in friction else None,
            friction=np.maximum(friction["coulomb"], 0.0) if "coulomb" in friction else None,
            damping_std=std.get("viscous"),
            friction_std=std.get("coulomb"),
            overwrite=overwrite,
        )

    def _new_log(self, X: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows (n, d) and torques (n, o) of another log of the robot."""
        rows, targets = validate_numbers(self, X, y, reset=False, dtype=np.float64)
        targets = np.asarray(targets, dtype=np.float64).reshape(len(rows), -1)
        if targets.shape[1] != len(self._joints):
            raise ValueError(f"y must have {len(self._joints)} columns, one for each joint; got {targets.shape[1]}.")
        check_magnitude(rows, "X")
        check_magnitude(targets, "y")
        return rows, targets

    def _inertial(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the means (n_links, 10) and the covariance of the inertial parameters of links."""
        size = 10 * len(self._outputs)
        return self.coef_[:size].reshape(-1, 10), self.coef_cov_[:size, :size]

    def _friction(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the friction from weights or their standard deviations, by name, in the units of the model."""
        n_joints = len(self._outputs)
        rest = values[10 * n_joints :].reshape(-1, n_joints) / np.abs(self.gains_)
        return dict(zip(self.feature_map_.friction, rest, strict=True))

    @available_if(_knows_a_robot)
    def estimate_payload(
        self,
        X: ArrayLike,
        y: ArrayLike,
        *,
        groups: ArrayLike | None = None,
        pieces: ArrayLike | None = None,
        link: int = -1,
        mass_scale: float = 5.0,
        size: float = 0.2,
    ) -> Bunch:
        """Estimate the mass and the inertia of a payload from a log with it.

        The ten parameters of the payload and those of the robot are identified together, from both logs. So the
        uncertainty of the robot widens the interval of the payload. Each move has its own offset, friction and gain,
        with the variances from `fit`. The mean of each f_j is subtracted as if it were known. The effects from
        `InverseDynamics.update` are ignored.

        Parameters
        ----------
        X : array-like of shape (n_samples, 3 * n_joints)
            Rows [q, q̇, q̈] with the payload, in the order of time.
        y : array-like of shape (n_samples, n_joints)
            Torques with the payload, in the units of `fit`.
        groups, pieces : array-like of shape (n_samples,), default=None
            Labels of moves and of pieces without gaps, as in `fit`. Without ``groups``, the log is one move.
        link : int, default=-1
            Index of the link that carries the payload. The default is the last link.
        mass_scale : float, default=5.0
            Prior standard deviation of the mass of the payload, kg. The prior mean is 0.
        size : float, default=0.2
            Prior standard deviation of the centre of mass, m. Use the size of the payload plus its distance from the
            frame of the joint.

        Returns
        -------
        payload : Bunch
            Parameters of the payload:

            - ``mass``, ``mass_std`` : mass, kg. A mass below 0 is possible if the errors are large;
            - ``mass_interval`` : tuple of two floats, the 95 % credible interval of the mass, kg;
            - ``com``, ``com_std`` : ndarray of shape (3,), centre of mass in the frame of the link's joint, m. The
              standard deviation is to first order. They are NaN and inf if the mass is not positive;
            - ``parameters``, ``covariance`` : ndarray of shape (10,) and (10, 10), inertial parameters in the order of
              those of a link.

        Raises
        ------
        ValueError, TypeError
            If shapes do not fit, data are not finite, or an argument is out of its range.

        References
        ----------
        - C. G. Atkeson, C. H. An, J. M. Hollerbach (1986): Estimation of Inertial Parameters of Manipulator Loads and
          Links, section 2.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import InverseDynamics
        >>> rng = np.random.default_rng(0)
        >>> X = rng.normal(size=(600, 3))
        >>> y = X[:, 2] / 4 + 9.81 / 2 * np.sin(X[:, 0]) + 0.01 * rng.normal(size=600)  # 1 kg at 0.5 m
        >>> model = InverseDynamics("pendulum", n_inducing=0).fit(X, y)
        >>> payload = model.estimate_payload(X, 1.5 * y, size=0.5)  # and 0.5 kg at the same place
        >>> (payload.parameters[[3]] / [-0.5]).round(2)  # torques depend on its first moment
        array([0.5])
        """
        check_is_fitted(self)
        n_outputs = len(self._joints)
        rows_x, targets = self._new_log(X, y)
        if check_integer(link, "link", minimum=-n_outputs) >= n_outputs:
            raise ValueError(f"link={link} must be the index of one of {n_outputs} links.")
        for name, value in (("mass_scale", mass_scale), ("size", size)):
            if check_real(value, name, minimum=0.0, strict=True) > _LARGEST_SCALE:
                raise ValueError(f"{name} must be at most {_LARGEST_SCALE:g}; got {value!r}.")
        rows = self._as_rows(rows_x, targets, groups, pieces)

        def missed(torque: np.ndarray) -> np.ndarray:
            return np.column_stack([f.mean(self._own(rows_x, torque, j)) for j, f in enumerate(self._joints)])

        def effects(torque: np.ndarray) -> np.ndarray:
            return self._effects(torque, rows.speed)

        # Without labels, or with one label, the log is one move.
        rows = replace(rows, groups=np.zeros(len(rows_x), dtype=int)) if rows.n_moves == 1 else rows
        n_effects = len(np.unique(rows.groups)) * n_outputs * len(EFFECTS)
        prior = payload_prior(self._weights.prior, n_effects, mass_scale, size)
        torque = self._weights.predict(rows.features)
        return find_payload(rows, link % n_outputs, prior, self._known, torque, missed, effects)

    def _terms(self, physics: np.ndarray, speed: np.ndarray) -> list[np.ndarray]:
        """Return z of each joint, (n, 4)."""
        columns = zip(self._joints, speed.T, physics.T, strict=True)
        return [terms(v, torque, joint.noise.velocity) for joint, v, torque in columns]

    def _effects(self, physics: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return z of each joint, times the standard deviations of the effects of moves, (n, o, 4)."""
        each = zip(self._joints, self._terms(physics, speed), strict=True)
        return np.stack([z * np.sqrt(np.diag(joint.effects.covariance)) for joint, z in each], axis=1)
