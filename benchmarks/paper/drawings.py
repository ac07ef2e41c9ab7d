"""The paper's Figures 1 to 4 by code: the model, the four systems, and gravity on a link in 3D.

Links lie where Pinocchio's forward kinematics puts them, masses and lengths are those of the simulated systems, and the
model is fitted to 60 points.

    python benchmarks/paper/drawings.py                       # into docs/images: seconds
    python benchmarks/paper/drawings.py --output some/folder
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.preprocessing import PolynomialFeatures

from harness import PALETTE, WIDTH, legend, pyplot, save_picture
from skevgp import CoefPrior, EVGPRegressor
from skevgp.datasets import load_robot, make_toy
from skevgp.solvers import LBFGS

BLUE, ORANGE, GREEN = PALETTE[:3]
INK, BODY, PALE = "0.2", "0.55", "0.8"
# Positions at which the systems are drawn: every angle is positive, except of the arm.
POSES = {
    "pendulum": (0.7,),
    "cartpole": (0.35, 0.6),
    "acrobot": (0.8, 0.6),
    "iiwa14": (0.3, 0.5, 0.3, -1.2, 0.5, 0.9, 0.0),
}
# Whose levers are drawn, and where; the arm's q4, turned by the joints before it.
LINK, LINK_POSE = 3, (0.0, 1.1, -1.2, 1.2, 0.0, 0.0, 0.0)
GRAVITY = np.array([0.0, 0.0, -9.81])


class Chain(NamedTuple):
    """Where the links of a robot are.

    Attributes
    ----------
    rotations : ndarray of shape (n_joints, 3, 3)
        Of each link in the world.
    origins : ndarray of shape (n_joints, 3)
        Of each joint, m.
    centers : ndarray of shape (n_joints, 3)
        Of mass of each link, m.
    masses : ndarray of shape (n_joints,)
        In kg.
    """

    rotations: np.ndarray
    origins: np.ndarray
    centers: np.ndarray
    masses: np.ndarray


def chain(system: str, q: Sequence[float]) -> Chain:
    """By forward kinematics."""
    import pinocchio

    robot = load_robot(system)
    data = robot.createData()
    pinocchio.forwardKinematics(robot, data, np.array(q))
    links = range(1, robot.njoints)
    return Chain(
        np.array([data.oMi[link].rotation for link in links]),
        np.array([data.oMi[link].translation for link in links]),
        np.array([data.oMi[link].act(robot.inertias[link].lever) for link in links]),
        np.array([robot.inertias[link].mass for link in links]),
    )


def feature(rotation: np.ndarray, lever: np.ndarray) -> float:
    """Gravity's torque on a unit lever of a link, about the link's own axis u_z: (u × Rᵀg)·u_z."""
    return float(np.cross(lever, rotation.T @ GRAVITY)[2])


# %% Strokes


def arrow(axes: Any, start: np.ndarray, end: np.ndarray, colour: str, width: float = 1.8, zorder: int = 5) -> None:
    from matplotlib.patches import FancyArrowPatch

    style = {"arrowstyle": "-|>", "color": colour, "linewidth": width, "mutation_scale": 12, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, zorder=zorder, **style))


def write(axes: Any, place: np.ndarray, text: str, colour: str = "black", dx: float = 0.0, dz: float = 0.0) -> None:
    """A name, so far from a place."""
    axes.text(place[0] + dx, place[1] + dz, text, color=colour, ha="center", va="center", zorder=6)


def arc(axes: Any, points: np.ndarray, colour: str, label: str, place: np.ndarray) -> None:
    """A curve that ends in an arrow, with its name at a place."""
    axes.plot(*points[:-1].T, color=colour, linewidth=1.4, zorder=4)
    arrow(axes, points[-3], points[-1], colour, 1.4, 4)
    write(axes, place, label, colour)


def hanging(angle: float | np.ndarray, sign: int) -> np.ndarray:
    """Where a link of length 1 ends that hangs at 0, in (x, z); the sign is that of its axis along y, away from us."""
    return np.stack([-sign * np.sin(angle), -np.cos(angle)], axis=-1)


def turn(axes: Any, center: np.ndarray, start: float, end: float, radius: float, sign: int, **how: Any) -> None:
    """An angle, from 0 or another link to a link."""
    points = center + radius * hanging(np.linspace(start, end, 40), sign)
    place = center + how.pop("out", 1.3) * radius * hanging((start + end) / 2, sign)
    arc(axes, points, how.get("colour", BLUE), how["label"], place)


def rod(axes: Any, start: np.ndarray, end: np.ndarray) -> None:
    axes.plot(*np.transpose([start, end]), color=BODY, linewidth=7, solid_capstyle="round", zorder=2)


def ball(axes: Any, place: np.ndarray, size: float, colour: str = INK) -> None:
    axes.plot(*place, "o", color=colour, markersize=size, zorder=3)


def pin(axes: Any, place: np.ndarray) -> None:
    axes.plot(*place, "o", color=INK, markerfacecolor="white", markersize=7, markeredgewidth=1.5, zorder=4)


def wall(axes: Any, center: np.ndarray, half: float, side: float) -> None:
    """What is fixed: a line with strokes above (positive) or below, so long."""
    axes.plot(center[0] + half * np.array([-1, 1]), [center[1]] * 2, color=INK, linewidth=1.5, zorder=1)
    for x in np.arange(-half, half - abs(side), abs(side)):
        stroke = center + np.array([[x, 0.0], [x + abs(side), side]])
        axes.plot(*stroke.T, color=PALE, linewidth=1, zorder=0)


def plumb(axes: Any, top: np.ndarray, length: float) -> None:
    axes.plot([top[0]] * 2, [top[1], top[1] - length], ":", color=INK, linewidth=1, zorder=1)


def frame(axes: Any, center: tuple[float, float], size: float) -> None:
    """The axes of the page."""
    corner = np.array(center)
    for direction, name in (((1, 0), "x"), ((0, 1), "z")):
        arrow(axes, corner, corner + size * np.array(direction), BODY, 1.2)
        write(axes, corner + 1.25 * size * np.array(direction), name, BODY)


def weight(axes: Any, place: np.ndarray, size: float, label: str = "g") -> None:
    arrow(axes, place, place + np.array([0.0, -size]), GREEN)
    write(axes, place, label, GREEN, dz=-1.2 * size)


# %% Systems


def pendulum(axes: Any) -> None:
    q = POSES["pendulum"]
    where = chain("pendulum", q)
    pivot, tip = where.origins[0, ::2], where.centers[0, ::2]
    wall(axes, pivot, 0.16, 0.03)
    plumb(axes, pivot, 0.45)
    rod(axes, pivot, tip)
    ball(axes, tip, 22)
    pin(axes, pivot)
    turn(axes, pivot, 0.0, q[0], 0.24, 1, label="q")
    turn(axes, pivot, -1.3, -0.4, 0.16, 1, label="u", colour=ORANGE, out=1.25)
    write(axes, tip, f"{where.masses[0]:g} kg", dz=-0.12)
    write(axes, tip / 2, f"{np.linalg.norm(tip):g} m", dx=-0.13, dz=0.06)
    weight(axes, np.array([0.23, -0.08]), 0.14)
    frame(axes, (0.2, -0.55), 0.12)
    axes.set(xlim=(-0.62, 0.5), ylim=(-0.66, 0.1))


def cartpole(axes: Any) -> None:
    from matplotlib.patches import Rectangle

    q = POSES["cartpole"]
    where = chain("cartpole", q)
    cart, tip = where.origins[1, ::2], where.centers[1, ::2]
    wall(axes, np.array([0.2, -0.09]), 0.75, -0.04)
    axes.add_patch(Rectangle(cart - (0.16, 0.09), 0.32, 0.18, facecolor=PALE, edgecolor=INK, zorder=1))
    plumb(axes, cart, 0.45)
    rod(axes, cart, tip)
    ball(axes, tip, 18)
    pin(axes, cart)
    turn(axes, cart, 0.0, q[1], 0.28, -1, label="θ")
    axes.plot([0.0, 0.0], [-0.09, 0.3], ":", color=INK, linewidth=1)
    arrow(axes, np.array([0.0, 0.25]), np.array([q[0], 0.25]), BLUE, 1.4)
    write(axes, cart / 2, "x", BLUE, dz=0.3)
    arrow(axes, cart + np.array([0.16, 0.0]), cart + np.array([0.42, 0.0]), ORANGE)
    write(axes, cart, "u", ORANGE, dx=0.47)
    write(axes, cart, f"{where.masses[0]:g} kg", dz=0.15)
    write(axes, tip, f"{where.masses[1]:g} kg", dz=-0.11)
    write(axes, (cart + tip) / 2, f"{np.linalg.norm(tip - cart):g} m", dx=0.12, dz=0.05)
    weight(axes, np.array([-0.35, -0.3]), 0.15)
    axes.set(xlim=(-0.6, 1.0), ylim=(-0.58, 0.4))


def acrobot(axes: Any) -> None:
    q = POSES["acrobot"]
    where = chain("acrobot", q)
    shoulder, elbow = where.origins[:, ::2]
    centers = where.centers[:, ::2]
    tip = elbow + 2.0 * (centers[1] - elbow)  # the centre of mass is in its middle
    wall(axes, shoulder, 0.45, 0.09)
    plumb(axes, shoulder, 1.0)
    axes.plot(*np.transpose([elbow, elbow + 0.9 * (elbow - shoulder)]), ":", color=INK, linewidth=1, zorder=1)
    for start, end in ((shoulder, elbow), (elbow, tip)):
        rod(axes, start, end)
    for joint in (shoulder, elbow):
        pin(axes, joint)
    for center, end, start, mass in zip(centers, (elbow, tip), (shoulder, elbow), where.masses, strict=True):
        ball(axes, center, 9)
        write(axes, center, f"{np.linalg.norm(end - start):g} m, {mass:g} kg", dx=-0.45, dz=0.16)
    turn(axes, shoulder, 0.0, q[0], 0.62, 1, label="$q_1$", out=1.2)
    turn(axes, elbow, q[0], sum(q), 0.62, 1, label="$q_2$", out=1.2)
    turn(axes, elbow, -1.2, 0.1, 0.38, 1, label="u", colour=ORANGE, out=1.25)
    weight(axes, np.array([0.6, -0.5]), 0.4)
    axes.set(xlim=(-2.9, 0.9), ylim=(-1.75, 0.25))


def camera(azimuth: float, elevation: float) -> np.ndarray:
    """From the world to the page (2, 3), without perspective; angles in degrees."""
    a, e = np.radians([azimuth, elevation])
    return np.array(
        [[-np.sin(a), np.cos(a), 0.0], [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]],
    )


def circle(center: np.ndarray, u: np.ndarray, v: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    """Points (n, 3) around a center, from u to v and on."""
    t = np.linspace(*ends, 60)[:, np.newaxis]
    return center + np.cos(t) * u + np.sin(t) * v


def iiwa14(axes: Any) -> None:
    where, page = chain("iiwa14", POSES["iiwa14"]), camera(-30.0, 18.0).T
    x, y, z = np.eye(3)
    places = np.vstack([np.zeros(3), where.origins])
    axes.fill(*(circle(0.0 * x, 0.28 * x, 0.28 * y, (0.0, 2 * np.pi)) @ page).T, color="0.93", zorder=0)
    axes.plot(*((places * (1, 1, 0)) @ page).T, color="0.85", linewidth=5, solid_joinstyle="round", zorder=1)
    axes.plot(*(places @ page).T, color=BODY, linewidth=9, solid_joinstyle="round", solid_capstyle="round", zorder=2)
    beside = {1: (-0.075, 0.0), 3: (-0.075, 0.0), 5: (0.0, 0.075)}  # names of axes whose tips the next joint hides
    for number, (rotation, origin) in enumerate(zip(where.rotations, where.origins, strict=True), start=1):
        axis = rotation[:, 2]
        barrel = np.array([origin - 0.045 * axis, origin + 0.045 * axis]) @ page
        axes.plot(*barrel.T, color=INK, linewidth=11, solid_capstyle="butt", zorder=3)
        arrow(axes, origin @ page, (origin + 0.15 * axis) @ page, BLUE, 1.4)
        place = origin @ page + beside[number] if number in beside else (origin + 0.2 * axis) @ page
        write(axes, place, f"$q_{number}$", BLUE)
    corner = np.array([0.35, -0.45, 0.0])
    for direction, name in ((x, "x"), (y, "y"), (z, "z")):
        arrow(axes, corner @ page, (corner + 0.14 * direction) @ page, BODY, 1.2)
        write(axes, (corner + 0.18 * direction) @ page, name, BODY)
    weight(axes, np.array([-0.3, 0.85]), 0.15)
    axes.margins(0.02)


def systems(path: Path) -> None:
    """The paper's Figure 3."""
    figure, grid = pyplot().subplots(2, 2, figsize=(WIDTH, 5.9), height_ratios=(1.0, 1.25))
    notes = {
        "pendulum": "torque u, viscous friction",
        "cartpole": "force u on the cart\ncartpole_damped: viscous friction, too",
        "acrobot": "torque u at the elbow, viscous friction",
        "iiwa14": "a torque about each of seven axes",
    }
    for axes, draw in zip(grid.flat, (pendulum, cartpole, acrobot, iiwa14), strict=True):
        draw(axes)
        axes.set_title(f"{draw.__name__}: {notes[draw.__name__]}")
        axes.set_aspect("equal", anchor="N")
        axes.set_axis_off()
    figure.suptitle(
        "All angles are 0 where a system hangs down, the arm's where it stands up; arrows show what is positive"
    )
    save_picture(figure, path)


# %% A link, and the model


def link(path: Path) -> None:
    """The paper's Figure 4: what gravity does to unit levers of a link, whatever its mass and its shape."""
    where, page = chain("iiwa14", LINK_POSE), camera(20.0, 20.0).T
    rotation = where.rotations[LINK]
    u_x, u_y, u_z = rotation.T
    origin = np.zeros(3)
    figure, (axes, words) = pyplot().subplots(1, 2, figsize=(WIDTH, 3.6), width_ratios=(1.15, 1.0))
    axes.plot(
        *(np.array([origin, 1.3 * u_y]) @ page).T,
        color="0.9",
        linewidth=34,
        solid_capstyle="round",
        zorder=0,
        clip_on=False,
    )
    axes.plot(
        *(np.array([-0.16 * u_z, 0.16 * u_z]) @ page).T, color=PALE, linewidth=30, solid_capstyle="butt", zorder=1
    )
    axes.plot(*(np.array([-0.5 * u_z, 1.2 * u_z]) @ page).T, "-.", color=INK, linewidth=1, zorder=1)
    arrow(axes, origin @ page, u_z @ page, INK, 2.2)
    write(axes, u_z @ page, "$u_z$", dx=0.09)
    for number, (lever, name, colour) in enumerate(((u_x, "u_x", ORANGE), (u_y, "u_y", BLUE))):
        tip, value = lever @ page, feature(rotation, np.eye(3)[number])
        arrow(axes, origin @ page, tip, colour, 2.2)
        write(axes, tip, f"${name}$", colour, dx=0.03, dz=0.1)
        weight(axes, tip, 0.5)
        around = circle(
            (0.75 - 0.25 * number) * u_z, 0.16 * lever, 0.16 * np.sign(value) * np.cross(u_z, lever), (0, 5)
        )
        arc(axes, around @ page, colour, "", origin @ page)
        formula = rf"$({name} \times R_i^\mathsf{{T}} g)\cdot u_z = {value:+.2f}$ m/s²"
        words.text(0.0, 0.36 - 0.14 * number, formula, color=colour, fontsize=12, va="center")
    said = """Link i (the arm iiwa14's fourth) turns about $u_z$.
Gravity at the end of a lever of length 1, along
$u_x$ or $u_y$, turns it as the round arrows show.

How far its mass lies out along each lever is left
to the weights β: the features are of unit levers
and forward kinematics ($R_i$) alone. The paper
takes $u_x$, skevgp by default both."""
    words.text(0.0, 0.95, said, va="top", linespacing=1.4)
    axes.set_aspect("equal")
    axes.margins(0.06)
    for panel in (axes, words):
        panel.set_axis_off()
    save_picture(figure, path)


def model(path: Path) -> None:
    """The paper's Figures 1 and 2: explicit features and a sparse Gaussian process add up to what is observed."""
    X, y = make_toy(60, random_state=0, return_X_y=True)
    settings = {
        "n_inducing": 10,
        "solver": LBFGS(posterior="diagonal"),
        "coef_prior": CoefPrior(mean=[0.0, 3.0], scale=[3.0, 1.0]),
    }
    evgp = EVGPRegressor(PolynomialFeatures(1), random_state=0, **settings).fit(X, y)
    x = np.linspace(-3.0, 9.0, 241)
    H = np.column_stack([np.ones_like(x), x])
    mean, std = evgp.predict(x[:, np.newaxis], return_std=True)
    line, line_variance = H @ evgp.coef_, np.einsum("ij,jk,ik->i", H, evgp.coef_cov_, H)
    f_std = np.sqrt(std**2 - line_variance - evgp.noise_variance_)  # this posterior has no covariance of β and f
    panels = (
        ("h(x)ᵀβ", "what an expert knows: a trend", line, np.sqrt(line_variance)),
        ("f(x)", "what is left: a sparse GP", mean - line, f_std),
        ("y", "what is observed, with noise ε", mean, std),
    )
    figure, grid = pyplot().subplots(1, 3, figsize=(WIDTH, 2.9), sharex=True, sharey=True)
    for axes, (name, title, middle, spread) in zip(grid, panels, strict=True):
        axes.fill_between(
            x, middle - 2 * spread, middle + 2 * spread, color=BLUE, alpha=0.2, linewidth=0, label="±2 std"
        )
        axes.plot(x, middle, color=BLUE, label="posterior mean")
        axes.set(title=title, xlabel="x")
        axes.text(0.04, 0.93, name, transform=axes.transAxes, fontsize=13, va="top")
    weights = np.random.RandomState(0).normal(evgp.coef_prior_mean_, evgp.coef_prior_scale_, (12, 2))
    grid[0].plot(x, H @ weights.T, color=PALE, linewidth=0.8, zorder=0)
    grid[0].plot([], [], color=PALE, linewidth=0.8, label="prior of β: draws")
    points = evgp.inducing_points_[:, 0]
    grid[1].plot(points, np.interp(points, x, mean - line), "x", color=GREEN, label="inducing points")
    grid[2].plot(X[:, 0], y, ".", color="0.4", markersize=4, zorder=0, label="data")
    for axes, sign in zip(grid[1:], "+=", strict=True):
        axes.text(-0.07, 0.5, sign, transform=axes.transAxes, fontsize=20, ha="center", va="center")
    legend(figure, "lower", ncols=5)
    grid[0].set(xticks=range(-2, 9, 2), ylabel="y")
    save_picture(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    images = Path(__file__).parents[2] / "docs" / "images"
    parser.add_argument("--output", type=Path, default=images, help="a folder; default: docs/images")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for draw, name in ((model, "model"), (systems, "systems"), (link, "link_3d")):
        draw(options.output / f"{name}.png")
        print(options.output / f"{name}.png")


if __name__ == "__main__":
    main()
