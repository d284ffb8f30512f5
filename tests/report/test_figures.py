"""Content of figures, read back from their artists."""

import warnings

import mujoco
import numpy as np
import pytest
from matplotlib import colors
from matplotlib.figure import Figure
from report.conftest import edited

from starjax.report import (
    figures,
    outcomes,
    results,
    scene_view,
    style,
    training_trocars,
    trajectories,
)
from starjax.sim.task import Outline

BOARD = np.array([[-0.05, -0.04, 0], [0.05, -0.04, 0], [0.05, 0.04, 0], [-0.05, 0.04, 0]])


def bare(_names):
    """A scene without recorded joints: an outline, no shafts."""
    return scene_view.SceneView(
        Outline((BOARD,), (BOARD[:2],)), lambda *_: pytest.fail("no joints")
    )


def test_success_is_pooled_by_distance_and_drawn_with_its_interval(one):
    (at, score), *further = figures._pooled(one)
    seen, unseen = outcomes.split(one.trials)
    assert at == pytest.approx(0, abs=1e-3) and score == outcomes.tally(seen)
    assert sum(score.trials for _, score in further) == len(unseen) == 24
    groups = [group[0] for group in outcomes.by_trocar(unseen)]
    apart = 1e3 * outcomes.distances(groups, results.training_trocars(one))
    np.testing.assert_allclose(apart, [30.29, 21.04, 21.46, 20.0], atol=0.01)
    scores = [score for _, score in figures._pooled(one)]
    ends = [[score.low, score.high] for score in scores]
    axis = Figure().subplots()
    style.rates(axis, range(len(scores)), scores, "stardiff", "")
    whiskers = [segment[:, 1] for segment in axis.collections[0].get_segments()]
    np.testing.assert_allclose(whiskers, ends)
    axis = figures.distance([one], one).axes[0]
    (intervals,) = axis.collections  # a line each, and no band between them
    np.testing.assert_allclose([part[:, 1] for part in intervals.get_segments()], ends)
    assert {line.get_linestyle() for line in axis.lines} == {"None"}
    limits = (one.limit_s, 7.0)  # a sweep with another limit is not pooled
    swept = [one._replace(sweep=one.result._replace(time_limit_s=limit)) for limit in limits]
    both, alone = (sum(rate.trials for _, rate in figures._pooled(run)) for run in swept)
    assert both == 2 * alone


def test_trocars_from_above_are_at_their_places_and_unseen_ones_orange(one):
    shown = figures.distance([one], one).axes[1].collections[0]
    groups = [group[0] for group in outcomes.by_trocar(one.trials)]
    wanted = [
        [1e3 * t.radius[0] * np.sin(t.polar[0]) * f(t.azimuth[0]) for f in (np.cos, np.sin)]
        for t in groups
    ]
    np.testing.assert_allclose(shown.get_offsets(), wanted, atol=1e-3)
    orange = [colors.to_hex(edge) == style.FAILURE.lower() for edge in shown.get_edgecolors()]
    assert orange == [not trial.seen for trial in groups]


def test_the_map_weighs_trocars_by_their_trials_and_ends_far_from_all():
    axis, at = Figure().subplots(), np.array([[-5.0, 0.0], [5.0, 0.0]])
    shown = figures._heat(axis, at, np.array([1.0, 0.0]), np.array([3, 1]))
    assert shown.get_array()[80, 80] == pytest.approx(0.75)
    shown = figures._heat(axis, np.array([[20.0, 0.0]]), np.array([1.0]), np.array([1]))
    filled = np.isfinite(np.ma.filled(shown.get_array(), np.nan))
    assert filled[80, 112] and not filled[80, 48] and 0.02 < filled.mean() < 0.2


def test_runs_side_by_side_have_each_their_curve(one, several, tmp_path):
    shared = [one, one._replace(label="the same weights")]
    assert len(figures.training(shared).axes[0].lines) == 1
    apart = [run._replace(log=tmp_path / f"{i}") for i, run in enumerate([one, one, *several])]
    drawn = figures.training(apart).axes[0].lines, figures.distance(apart, one).axes[0].lines
    for lines in drawn:
        named = [line for line in lines if not line.get_label().startswith("_")]
        assert len({(x.get_color(), x.get_linestyle()) for x in named}) == 5 == len(named)
    point = one._replace(curves=[{"step": 1, "loss": 0.5}])
    assert figures.training([point]).axes[0].lines[0].get_marker() == "o"  # or it would not show


def test_an_error_that_is_always_zero_has_no_logarithmic_axis(one):
    exact = [{"step": step, "loss": 1 / step, "roll_error_deg": 0.0} for step in (1, 2)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        axes = figures.training([one._replace(curves=exact)]).axes
    assert [axis.get_yscale() for axis in axes if axis.lines] == ["log", "linear"]


def test_labels_are_drawn_as_they_are_written_and_fit(several):
    long = "b$x^^$ " + 60 * "x"
    figure = figures.distance([run._replace(label=long) for run in several], several[0])
    (legend,) = figure.legends
    style.save(figure, "png")
    assert legend.get_texts()[0].get_text() == long
    assert legend.get_window_extent().x1 <= figure.bbox.x1


def test_success_against_the_number_of_training_trocars(one):
    runs = [
        edited(one, [t._replace(seen=t.trocar < count) for t in one.trials]) for count in (1, 2, 8)
    ]
    assert training_trocars.never_seen(runs) == {8, 9, 10, 11}
    assert [training_trocars.trained_at(run) for run in runs] == [1, 2, 8]
    expected = outcomes.tally(t for t in one.trials if t.trocar >= 8).rate
    np.testing.assert_allclose(training_trocars.draw(runs).axes[0].lines[0].get_ydata(), expected)
    assert (
        training_trocars.draw(runs[1:2]) is None
        and training_trocars.draw([runs[2], runs[2]]) is None
    )


def test_paths_are_over_the_outline_seen_trocars_above_unseen_ones(one):
    figure = trajectories.draw([one], bare)
    titles = [axis.get_title("left").split() for axis in figure.axes]
    assert [title[0] for title in titles] == ["Seen"] * 3 + ["Unseen"] * 3
    assert [int(title[2]) < 8 for title in titles] == [True] * 3 + [False] * 3
    for axis in figure.axes:
        board = axis.patches[0].get_xy()[:4]
        np.testing.assert_allclose(board, trajectories._flat(BOARD), atol=1e-9)
    keys = {key.get_label(): key.get_color() for key in figure.legends[0].legend_handles}
    colour = {True: style.SUCCESS, False: style.FAILURE}
    assert (keys["success"], keys["failure"]) == tuple(colour.values())
    for won, wanted in colour.items():
        trial = one.rollouts[0].trial._replace(success=won)
        run = one._replace(rollouts=[one.rollouts[0]._replace(trial=trial)])
        lines = trajectories.draw([run], bare).axes[0].lines
        assert {x.get_color() for x in lines} & set(colour.values()) == {wanted}
        (shadow,) = [line.get_xydata() for line in lines if line.get_alpha() == 0.4]
        below = one.rollouts[0].p_world_tip[:, 0] * [1, 1, 0]
        np.testing.assert_allclose(shadow, trajectories._flat(below))


def test_several_methods_are_drawn_at_the_trial_that_most_of_them_met(several):
    runs = []
    for run, seed in zip(several, (1, 0, 1), strict=True):
        rollouts = [r._replace(trial=r.trial._replace(seed=seed)) for r in run.rollouts]
        runs.append(run._replace(rollouts=rollouts))
    figure = trajectories.draw(runs, bare)
    method = {style.method(run.result.method)[0]: run.label for run in runs}
    drawn = {method[x.get_color()] for x in figure.axes[0].lines if x.get_color() in method}
    assert drawn == {runs[0].label, runs[2].label}
    (legend,) = trajectories.draw([runs[0]._replace(rollouts=[]), *runs[1:]], bare).legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == [*(run.label for run in runs[1:]), "failure", "trocar"]


def test_each_arm_has_its_path_its_trocar_and_its_port(one):
    def doubled(trial):
        places = {name: 2 * getattr(trial, name) for name in ("radius", "polar", "azimuth")}
        return trial._replace(**places)

    rollout = one.rollouts[0]
    rollout = rollout._replace(
        trial=doubled(rollout.trial),
        p_world_tip=np.concatenate([rollout.p_world_tip, rollout.p_world_tip + 0.01], 1),
        p_world_trocar=np.concatenate([rollout.p_world_trocar, rollout.p_world_trocar + 0.05]),
    )
    run = edited(one, map(doubled, one.trials))._replace(rollouts=[rollout])
    lines = trajectories.draw([run], bare).axes[0].lines
    crosses = [line.get_xydata()[0] for line in lines if line.get_marker() == "x"]
    np.testing.assert_allclose(crosses, trajectories._flat(rollout.p_world_trocar))
    assert sum(len(x.get_xydata()) == rollout.trial.steps for x in lines) == 4  # with shadows
    assert len(figures.distance([run], run).axes[1].collections[0].get_offsets()) == 24
    assert outcomes.place(run.trials[0])[0].count("/") == 1
    apart = [outcomes.distances(x.trials, results.training_trocars(x)) for x in (run, one)]
    np.testing.assert_allclose(*apart)


def test_shafts_are_drawn_where_the_joints_had_them(one):
    from starjax.sim import registries, scene

    names = one.result.scene
    data = mujoco.MjData(scene.compose(names))
    mujoco.mj_kinematics(data.model, data)
    tcp = data.site(scene.tcp(0, registries.tools.get(names.tools[0])))
    qpos = np.tile(data.qpos, (20, 1))
    rollout = one.rollouts[0]._replace(p_world_tip=one.rollouts[0].p_world_tip[:20], qpos=qpos)
    axis = trajectories.draw([one._replace(rollouts=[rollout])], scene_view.load).axes[0]
    fan = [line.get_xydata() for line in axis.lines if line.get_alpha() == 0.34]
    length = np.linalg.norm(tcp.xpos - rollout.p_world_trocar[0]) + trajectories._BEYOND
    ends = np.stack([tcp.xpos - length * tcp.xmat.reshape(3, 3)[:, 2], tcp.xpos])
    np.testing.assert_allclose(fan, trajectories._FAN * [trajectories._flat(ends)], atol=1e-9)


def test_a_tool_that_flew_off_does_not_shrink_the_scene(one):
    outline = bare(None).outline
    near = trajectories._frame(outline, [one])
    far = one.rollouts[0]._replace(p_world_tip=one.rollouts[0].p_world_tip + 2.0)
    frame = trajectories._frame(outline, [one._replace(rollouts=[far, *one.rollouts])])
    for (low, high), (lowest, highest) in zip(near, frame, strict=True):
        assert lowest >= low - trajectories._ROOM and highest <= high + trajectories._ROOM
