"""Drawings of the paper's figures: links lie where the systems' equations put them."""

import numpy as np
import pytest
from matplotlib import pyplot
from numpy.testing import assert_allclose

from skevgp.features import LinkGravity


@pytest.fixture
def drawings(benchmarks):
    from paper import drawings

    return drawings


@pytest.fixture
def strokes(drawings, monkeypatch):
    """Draw a system; gives the start and end of its arrows, by colour, and the points of its arcs, by label."""

    def strokes(name):
        arrows, arcs = {}, {}
        how = {
            "arrow": lambda axes, start, end, colour, *_: arrows.setdefault(colour, []).append((start, end)),
            "arc": lambda axes, points, colour, label, place: arcs.update({label: points}),
        }
        for stroke, keep in how.items():
            monkeypatch.setattr(drawings, stroke, keep)
        figure, axes = pyplot.subplots()
        getattr(drawings, name)(axes)
        pyplot.close(figure)
        return arrows, arcs

    return strokes


def texts(axes):
    return {text.get_text() for text in axes.texts}


def beside(q, joint):
    """A position a little further."""
    return np.array(q) + 1e-6 * np.eye(len(q))[joint]


def test_planar_systems_turn_as_their_equations_say(drawings):
    """Axis +y moves a tip that hangs to -x, axis -y to +x."""
    q = 0.3, 0.8
    assert_allclose(drawings.chain("pendulum", q[:1]).centers, [[-0.5 * np.sin(0.3), 0.0, -0.5 * np.cos(0.3)]])
    cart, tip = drawings.chain("cartpole", q).centers
    assert_allclose(cart, [0.3, 0.0, 0.0])
    assert_allclose(tip, [0.3 + 0.5 * np.sin(0.8), 0.0, -0.5 * np.cos(0.8)], atol=1e-15)
    where = drawings.chain("acrobot", q)
    elbow = np.array([-np.sin(0.3), 0.0, -np.cos(0.3)])
    assert_allclose(where.origins, [[0.0, 0.0, 0.0], elbow], atol=1e-15)
    assert_allclose(where.centers, [0.5 * elbow, elbow - [np.sin(1.1), 0.0, np.cos(1.1)]], atol=1e-15)
    for sign, system in ((1, "pendulum"), (-1, "cartpole")):
        where = drawings.chain(system, drawings.POSES[system])
        link = where.centers[-1] - where.origins[-1]
        assert_allclose(link[::2], 0.5 * drawings.hanging(drawings.POSES[system][-1], sign), atol=1e-15)


def test_the_arm_stands_up_and_tips_as_its_model_says(drawings):
    up = drawings.chain("iiwa14", np.zeros(7))
    assert_allclose(up.origins[-1], [0.0, 0.0, 1.261], atol=1e-12)
    for joint, sense in ((1, 1.0), (3, -1.0)):
        assert np.sign(drawings.chain("iiwa14", 0.3 * np.eye(7)[joint]).origins[-1, 0]) == sense


@pytest.mark.parametrize(("name", "lever"), [("u_x", 0), ("u_y", 1)])
def test_a_lever_has_the_value_of_its_feature(drawings, name, lever):
    x = np.r_[drawings.LINK_POSE, np.zeros(14)][np.newaxis]
    features = LinkGravity("iiwa14", links=[f"q{drawings.LINK + 1}"]).fit(x)
    values = dict(zip(features.get_feature_names_out(), features.transform(x)[0], strict=True))
    rotation = drawings.chain("iiwa14", drawings.LINK_POSE).rotations[drawings.LINK]
    assert drawings.feature(rotation, np.eye(3)[lever]) == pytest.approx(values[f"gravity(q4, {name})"])
    assert abs(values[f"gravity(q4, {name})"]) > 1.0  # something to be seen


def test_the_page_has_x_to_the_right_and_z_up(drawings):
    assert_allclose(drawings.camera(-90.0, 0.0), [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)
    view = drawings.camera(20.0, 20.0)
    assert_allclose(view @ view.T, np.eye(2), atol=1e-15)
    towards_us = np.cross(*view)
    assert_allclose(towards_us, [np.cos(np.pi / 9) ** 2, np.sin(np.pi / 9) * np.cos(np.pi / 9), np.sin(np.pi / 9)])


def test_the_four_systems_are_drawn_with_their_numbers(drawings, drawn, tmp_path):
    (figure,) = drawn(drawings.systems, tmp_path / "systems.png")
    panels = {axes.get_title().split(":")[0]: axes for axes in figure.axes}
    assert list(panels) == ["pendulum", "cartpole", "acrobot", "iiwa14"]
    assert {"q", "u", "g", "1 kg", "0.5 m"} <= texts(panels["pendulum"])
    assert {"x", "θ", "u", "g", "10 kg", "1 kg", "0.5 m"} <= texts(panels["cartpole"])
    assert {"$q_1$", "$q_2$", "u", "1 m, 1 kg", "2 m, 1 kg"} <= texts(panels["acrobot"])
    assert {f"$q_{joint}$" for joint in range(1, 8)} <= texts(panels["iiwa14"])
    tips = {
        "pendulum": drawings.chain("pendulum", drawings.POSES["pendulum"]).centers[0, ::2],
        "cartpole": drawings.chain("cartpole", drawings.POSES["cartpole"]).centers[1, ::2],
    }
    for name, tip in tips.items():
        balls = [line.get_xydata()[0] for line in panels[name].lines if line.get_markersize() > 15]
        assert_allclose(balls, [tip])
    assert "cartpole_damped: viscous friction" in panels["cartpole"].get_title()
    words = [text for axes in panels.values() for text in (*axes.texts, axes.title)]
    for text in (*words, *figure.texts):  # nothing is cut off
        (left, low), (right, high) = text.get_window_extent().get_points()
        assert min(left, low) > 0.0, text.get_text()
        assert right < figure.bbox.width, text.get_text()
        assert high < figure.bbox.height, text.get_text()


@pytest.mark.parametrize(
    ("name", "joint", "labels"),
    [("pendulum", 0, {"q", "u"}), ("cartpole", 1, {"θ"}), ("acrobot", 0, {"$q_1$"}), ("acrobot", 1, {"$q_2$", "u"})],
)
def test_round_arrows_turn_as_a_growing_angle_turns_the_link(drawings, strokes, name, joint, labels):
    q = drawings.POSES[name]
    center = drawings.chain(name, q).origins[joint, ::2]
    links = [drawings.chain(name, p).centers[joint, ::2] for p in (q, beside(q, joint))]

    def sense(start, end):
        return np.sign(np.linalg.det([start - center, end - center]))

    _, arcs = strokes(name)
    for label in labels:
        assert sense(arcs[label][0], arcs[label][1]) == sense(*links), label


def test_the_carts_arrows_show_where_it_goes(drawings, strokes):
    q = drawings.POSES["cartpole"]
    before, after = (drawings.chain("cartpole", p).origins[0, ::2] for p in (q, beside(q, 0)))
    arrows, _ = strokes("cartpole")
    for colour in (drawings.BLUE, drawings.ORANGE):
        ((start, end),) = arrows[colour]
        assert_allclose((end - start) / np.linalg.norm(end - start), (after - before) / 1e-6, atol=1e-6)


def test_the_arms_arrows_are_the_axes_about_which_it_turns(drawings, strokes):
    q = drawings.POSES["iiwa14"]
    arrows, _ = strokes("iiwa14")
    page = drawings.camera(-30.0, 18.0).T
    for joint, (start, end) in enumerate(arrows[drawings.BLUE]):
        before, after = (drawings.chain("iiwa14", p).rotations[joint] for p in (q, beside(q, joint)))
        turn = (after @ before.T - np.eye(3)) / 1e-6  # by the right hand about the axis
        assert_allclose(end - start, 0.15 * np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) @ page, atol=1e-6)
    assert len(arrows[drawings.BLUE]) == 7


def test_the_link_is_drawn_with_both_levers(drawings, drawn, tmp_path):
    (figure,) = drawn(drawings.link, tmp_path / "link.png")
    picture, words = figure.axes
    assert {"$u_x$", "$u_y$", "$u_z$", "g"} <= texts(picture)
    assert sum("= -4.57$ m/s²" in text or "= +3.00$ m/s²" in text for text in texts(words)) == 2


def test_the_two_parts_of_the_model_add_up(drawings, drawn, tmp_path):
    (figure,) = drawn(drawings.model, tmp_path / "model.png")
    known, left, both = (
        next(line.get_ydata() for line in axes.lines if line.get_label() == "posterior mean") for axes in figure.axes
    )
    assert_allclose(known + left, both, atol=1e-12)
    assert np.ptp(np.diff(known)) < 1e-9  # a line
    assert [axes.get_xlabel() for axes in figure.axes] == ["x"] * 3
    low, high = figure.axes[0].get_ylim()
    for axes in figure.axes:  # no band is cut off
        ends = axes.collections[0].get_datalim(axes.transData).intervaly
        assert low < min(ends) < max(ends) < high
    crosses = next(line for line in figure.axes[1].lines if line.get_label() == "inducing points")
    assert len(crosses.get_xdata()) == 10


@pytest.mark.long
def test_all_are_written_small(run_script, tmp_path):
    run_script("paper/drawings.py", "--output", tmp_path / "images")
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "images").iterdir()}
    assert sizes.keys() == {"model.png", "systems.png", "link_3d.png"}
    assert min(sizes.values()) > 10_000
    assert max(sizes.values()) < 100_000
