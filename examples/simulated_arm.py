"""
Logs of a simulated arm
=======================

This module simulates logs for the examples that need a real robot. An arm of the package example-robot-data moves along
sums of sines. Its gears have viscous friction, and Coulomb friction that grows with the load, as in harmonic drives. A
file gets the signals that a robot's controller would record: irregular times, positions, velocities and currents.
"""

import numpy as np
import pinocchio

CATALOGUE_GAINS = np.array([14.0, 14.0, 12.0, 10.0, 10.0, 10.0])  # torque per current, N m/A
GAINS = CATALOGUE_GAINS * [0.95, 0.94, 0.96, 0.93, 0.97, 0.95]  # the true gains
HOME = np.array([0.0, -1.6, 0.4, -1.6, 0.3, 0.0])  # an arm that stands upright with a bent elbow, rad
VISCOUS = np.array([12.0, 12.0, 8.0, 3.0, 3.0, 2.0])  # N m s/rad
COULOMB = np.array([8.0, 8.0, 5.0, 2.0, 2.0, 1.5])  # N m
BY_LOAD = 0.05  # Coulomb's friction per torque
STICTION_VELOCITY = 0.02  # rad/s


def sums_of_sines(times, rng, speed=0.2):
    """Return positions, velocities and accelerations of six joints. Harmonics of 0.1 Hz go up to 0.8 Hz."""
    omega = 2.0 * np.pi * 0.1 * np.arange(1, 9)
    amplitude = speed * rng.standard_normal((6, 8)) / omega
    phase = omega * times[:, np.newaxis, np.newaxis] + rng.uniform(0.0, 2.0 * np.pi, (6, 8))
    position = HOME + np.sum(amplitude * np.sin(phase), axis=2)
    velocity = np.sum(amplitude * omega * np.cos(phase), axis=2)
    return position, velocity, -np.sum(amplitude * omega**2 * np.sin(phase), axis=2)


def torques(robot, position, velocity, acceleration):
    """Return the torques of the motors: those of the rigid bodies, and friction."""
    data = robot.createData()
    rows = zip(position, velocity, acceleration, strict=True)
    body = np.array([pinocchio.rnea(robot, data, *row) for row in rows])
    sign = np.tanh(velocity / STICTION_VELOCITY)
    return body + VISCOUS * velocity + (COULOMB + BY_LOAD * np.abs(body)) * sign


def write_log(file, robot, seconds, random_state, noise=0.02, loaded=None, change=np.inf):
    """Write a log in the columns time, 6 positions, 6 velocities, 6 currents, about every 8 ms.

    After ``change`` seconds, the arm is ``loaded``.
    """
    rng = np.random.RandomState(random_state)
    times = np.arange(0.0, seconds, 0.008)
    times += rng.uniform(0.0, 0.004, len(times))
    motion = sums_of_sines(times, rng)
    current = torques(robot, *motion) / GAINS
    if loaded is not None:
        after = times >= change
        current[after] = torques(loaded, *(part[after] for part in motion)) / GAINS
    current += noise * current.std(axis=0) * rng.standard_normal(current.shape)
    velocity = motion[1] + 1e-3 * rng.standard_normal(current.shape)
    np.savetxt(file, np.column_stack([times, motion[0], velocity, current]), delimiter=",", fmt="%.6f")


def with_payload(robot, mass, com):
    """Return a copy of the arm with a body of 5 cm, from its mass (kg) and place (m) in the last joint's frame."""
    loaded = robot.copy()
    loaded.appendBodyToJoint(
        robot.njoints - 1,
        pinocchio.Inertia(mass, np.asarray(com, dtype=float), 0.4 * mass * 0.05**2 * np.eye(3)),
        pinocchio.SE3.Identity(),
    )
    return loaded
