"""Training on a generated ball, and what counts in it."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest
from ray_cast_ball import SIZE, VIEWS, ball_points, ball_view, camera_round

from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.initialise import select
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.objective import Objective
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import TrainingDiverged, TrainParams, train


def test_training_finds_colours_shape_and_depth_of_a_ball():
    result = train(ball_points(), VIEWS, params=TrainParams(iterations=400), extent=1.6, seed=1)
    errors = [
        (render(result.gaussians, view.camera).rgb.clip(0, 1) - view.image)[view.inside].ravel() for view in VIEWS
    ]
    assert np.square(np.concatenate(errors)).mean() < 10**-2.9
    assert result.loss[-50:].mean() < 0.3 * result.loss[:20].mean()
    unseen = ball_view(0.3)
    out = render(result.gaussians, unseen.camera)
    inside = unseen.inside
    assert np.square(out.rgb - unseen.image)[inside].mean() < 10**-2.7
    assert out.alpha[inside].mean() > 0.95 and out.alpha[~inside].mean() < 0.2
    assert np.abs(out.depth / np.maximum(out.alpha, 1e-6) - unseen.depth)[inside].mean() < 0.15
    assert (result.gaussians.instance_id == 4).all() and (result.gaussians.instance_conf == 0.5).all()
    assert np.allclose(np.linalg.norm(result.gaussians.quaternions, axis=1), 1, atol=1e-5)


def test_each_instance_has_a_limit_of_its_own_to_how_long_gaussians_become_and_the_background_none():
    ball = ball_points()
    ids = np.arange(len(ball), dtype=np.int32) % 3
    longer = ball.log_scales + np.log(np.array([1, 1, 4], np.float32))[ids][:, None]
    longer[:6] += 1.5  # two of each
    begun = replace(ball, instance_id=ids, log_scales=longer)
    params = TrainParams(iterations=1, densify="none", max_length=1.2, prune_contribution=0.0, prune_opacity=0.0)
    ended = train(begun, VIEWS, params=params, extent=1.6, seed=1).gaussians
    most = [ended.log_scales[ids == i].max() - np.median(longer[ids == i].max(axis=1)) for i in range(3)]
    assert most[0] > 1 and np.allclose(most[1:], np.log(1.2), atol=1e-5)


def test_the_mask_loss_gives_pixels_back_to_their_instance():
    half = ball_points()
    labels = np.where(half.means[:, 1] < 0, 4, 9).astype(np.int32)
    wrong = labels.copy()
    wrong[::7] = np.where(labels[::7] == 4, 9, 4)
    views = []
    for view in VIEWS:
        world_y = (view.depth * ((np.mgrid[:SIZE, :SIZE][0] + 0.5 - SIZE / 2) / 60.0)).astype(np.float32)
        ids = np.where(view.inside, np.where(world_y < 0, 0, 1), -2).astype(np.int32)
        views.append(replace(view, ids=ids))
    params = TrainParams(iterations=150, densify="none", mask_weight=1.0, prune_opacity=0.0)
    params = replace(params, prune_contribution=0.0)
    mixed = replace(half, instance_id=wrong, opacity_logits=np.full(len(half), np.log(0.01 / 0.99), np.float32))

    def error(gaussians) -> float:
        out = render(gaussians, views[0].camera, label_ids=(4, 9)).label_masks
        return float(np.abs(out - np.stack([views[0].ids == 0, views[0].ids == 1])).mean())

    with_masks = train(mixed, views, params=params, extent=1.6, seed=0, label_ids=(4, 9)).gaussians
    without = train(mixed, views, params=replace(params, mask_weight=0.0), extent=1.6, seed=0).gaussians
    assert error(with_masks) < 0.8 * error(without)
    assert np.array_equal(with_masks.instance_id, wrong)


@pytest.mark.parametrize("background", ["random", "black"])
def test_ignored_pixels_do_not_count(native, background):
    noise = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    views = [replace(v, free=np.zeros_like(v.free)) for v in VIEWS]
    disturbed = [replace(v, image=np.where(v.inside[..., None], v.image, noise)) for v in views]
    params = TrainParams(iterations=20, objective=Objective(background=background))
    a, b = (train(ball_points(), x, params=params, extent=1.6, seed=0) for x in (views, disturbed))
    assert a.gaussians.means.tobytes() == b.gaussians.means.tobytes()


def test_on_black_photos_colour_counts_where_nothing_may_be_seen_and_the_photo_does_not(native):
    noise = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    disturbed = [replace(v, image=np.where(v.inside[..., None], v.image, noise)) for v in VIEWS]
    blind = [replace(v, free=np.zeros_like(v.free)) for v in VIEWS]
    black = TrainParams(iterations=60, objective=Objective(background="black", alpha_weight=0.0))
    as_it_is, other, unjudged = (
        train(ball_points(), views, params=black, extent=1.6, seed=0).gaussians for views in (VIEWS, disturbed, blind)
    )
    assert as_it_is.means.tobytes() == other.means.tobytes()
    outside = ~VIEWS[0].inside
    shown, spilt = (render(g, VIEWS[0].camera).rgb[outside].mean() for g in (as_it_is, unjudged))
    assert shown < 0.7 * spilt


@pytest.mark.parametrize("objective", [Objective(background="white"), Objective(depth_error="absolute")])
def test_an_objective_that_does_not_exist_is_refused(objective):
    with pytest.raises(ValueError, match="must be one of"):
        train(ball_points(), VIEWS, params=TrainParams(iterations=5, objective=objective), extent=1.6, seed=0)


def test_a_depth_loss_of_inverse_depths_brings_the_surface_to_its_place():
    far = replace(ball_points(), means=ball_points().means * np.float32(1.25))
    off = []
    for weight in (0.0, 2.0):
        objective = Objective(depth_error="inverse", depth_weight_start=weight, depth_weight_final=weight)
        params = TrainParams(iterations=150, objective=objective, densify="none")
        out = render(train(far, VIEWS, params=params, extent=1.6, seed=1).gaussians, VIEWS[0].camera)
        inside = VIEWS[0].inside
        off.append(np.abs(out.depth / np.maximum(out.alpha, 1e-6) - VIEWS[0].depth)[inside].mean())
    assert off[1] < 0.8 * off[0]


def test_only_the_view_of_the_step_is_laid_out_for_the_losses():
    laid_out = []

    class Watching(NativeBackend):
        def descent(self, values, labels, target, *rest):
            laid_out.append(weakref.ref(target))
            assert sum(one() is not None for one in laid_out) == 1
            return super().descent(values, labels, target, *rest)

    params = TrainParams(iterations=2 * len(VIEWS))
    train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, backend=Watching(1))
    assert len(laid_out) == params.iterations


def test_bad_input_is_refused():
    params = TrainParams(iterations=5)
    with pytest.raises(ValueError, match="views"):
        train(ball_points(), [], params=params, extent=1, seed=0)
    with pytest.raises(ValueError, match="inside"):
        train(ball_points(), [replace(VIEWS[0], inside=np.ones((3, 3), bool))], params=params, extent=1, seed=0)
    with pytest.raises(ValueError, match="extent"):
        train(ball_points(), VIEWS, params=params, extent=0, seed=0)


def test_a_training_that_blows_up_says_so():
    with pytest.raises(TrainingDiverged, match="diverged"):
        train(
            ball_points(), VIEWS, params=TrainParams(iterations=60, rates=LearningRates(scale=1e38)), extent=1.6, seed=0
        )


def test_a_loss_that_is_not_finite_is_told_with_its_step_wherever_training_ends():
    class Broken(NativeBackend):
        def descent(self, values, *rest):
            found = super().descent(values, *rest)
            return found._replace(loss=np.nan if len(values["means"]) == 300 else 0.0)

    params = TrainParams(iterations=7, densify="none")
    with pytest.raises(TrainingDiverged, match=r"300 Gaussians diverged at step 1$"):
        train(ball_points(), VIEWS, params=params, extent=1.6, seed=0, backend=Broken(1))


@pytest.mark.parametrize(
    ("rules", "left"), [({}, 300), ({"prune_opacity": 0.02}, 290), ({"prune_contribution": 1e-9}, 280)]
)
def test_what_is_faint_and_what_no_view_shows_are_dropped_in_the_end(rules, left):
    ball = ball_points()
    ball.opacity_logits[:10] = -5
    ball.means[10:30] = (0, 50, 0)  # beside all views
    params = TrainParams(iterations=1, densify="none", **{"prune_opacity": 0.0, "prune_contribution": 0.0, **rules})
    assert len(train(ball, VIEWS, params=params, extent=1.6, seed=1).gaussians) == left


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_what_is_hidden_from_all_views_is_dropped_in_the_end_if_asked(share):
    ball = ball_points()
    ball.opacity_logits[:] = 4
    ball.means[:20] *= 0.05  # inside; the others hide them
    params = TrainParams(iterations=1, densify="none", prune_opacity=0.0, prune_contribution=0.0, prune_hidden=share)
    left = train(ball, VIEWS, params=params, extent=1.6, seed=1).gaussians
    inside = np.linalg.norm(left.means, axis=1) < 0.5 * np.linalg.norm(ball.means[20:], axis=1).min()
    assert inside.sum() == (0 if share else 20)
    assert 240 < (~inside).sum() <= 280  # some of the ball's far side is hidden as well


def test_a_limit_of_none_lets_densification_go_on():
    few = select(ball_points(), np.arange(60))
    counts = [
        len(train(few, VIEWS, params=TrainParams(iterations=240, max_gaussians=most), extent=1.6, seed=1).gaussians)
        for most in (60, 30_000, 0)
    ]
    assert counts[0] <= 60 < counts[1] == counts[2]


def test_opaque_rendering_ignores_the_opacities():
    faint = replace(ball_points(), opacity_logits=np.full(300, -4, np.float32))
    camera = camera_round(0)
    centre = SIZE // 2
    assert render(faint, camera).alpha[centre, centre] < 0.5
    assert render(faint, camera, opaque=True).alpha[centre, centre] > 0.95


def test_the_mismatch_is_the_absolute_error_of_all_label_masks():
    rng = np.random.default_rng(5)
    ball = ball_points()
    channels = rng.integers(-1, 4, len(ball)).astype(np.int32)
    ids = rng.integers(-2, 4, (SIZE, SIZE)).astype(np.int32)
    parameters = tuple(getattr(ball, name) for name in PARAMETERS)
    settings = Settings((0.0, 0.0, 0.0), 4, 0, winners=False)
    masks = NativePass(parameters, channels, camera_round(0), settings).masks
    single = NativePass(parameters, channels, camera_round(0), settings, ids=ids)
    one_hot = ids == np.arange(4)[:, None, None]
    assert np.allclose(single.mismatch + (ids >= 0), np.abs(masks - one_hot).sum(axis=0), atol=1e-5)
    # The same gradient: each mask's is the sign of its error.
    a = single.backward(None, None, None, np.ones((SIZE, SIZE), np.float32))
    whole = NativePass(parameters, channels, camera_round(0), settings)
    b = whole.backward(None, None, None, np.where(one_hot, -1, 1).astype(np.float32))
    for name in PARAMETERS[:4]:
        assert np.allclose(a[name], b[name], atol=1e-5), name
