"""Training on a generated ball, and what counts in it."""

from __future__ import annotations

import threading
import weakref
from dataclasses import replace

import numpy as np
import pytest

from ss_flow.running import Surroundings, running
from ss_flow.tasks.artifacts import Gaussians
from ss_flow.tasks.gaussians import trainer
from ss_flow.tasks.gaussians.backends import NativeBackend
from ss_flow.tasks.gaussians.initialise import concatenate, initialise, select
from ss_flow.tasks.gaussians.learning_rates import LearningRates
from ss_flow.tasks.gaussians.native_pass import PARAMETERS, NativePass, Settings
from ss_flow.tasks.gaussians.objective import Objective, Target
from ss_flow.tasks.gaussians.render import render
from ss_flow.tasks.gaussians.trainer import PartView, TrainingDiverged, TrainParams, train
from ss_flow.tasks.gaussians.views import TrainView
from ss_flow.tasks.geometry.cameras import Camera

SIZE = 48


@pytest.fixture
def native(monkeypatch):
    """Train on the CPU wherever the tests run: only there the same inputs give the same bytes."""
    monkeypatch.setattr(trainer, "device_here", lambda: "cpu")


def camera_round(angle: float) -> Camera:
    """Looks at the origin from 3 units away, in the plane y = 0."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[2, 3] = 3
    return Camera(SIZE, SIZE, 60.0, 60.0, SIZE / 2, SIZE / 2, pose)


def color_at(points: np.ndarray) -> np.ndarray:
    return (0.5 + 0.4 * np.sin(3 * points + (0, 1, 2))).astype(np.float32)


def ball_view(angle: float) -> TrainView:
    """The ball of radius 0.8 about the origin, cast ray by ray."""
    camera = camera_round(angle)
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    rays = rays @ camera.world_to_camera[:3, :3]
    a, b, c = (rays**2).sum(-1), rays @ camera.center, camera.center @ camera.center - 0.64
    root = b * b - a * c
    inside = root > 0
    z = np.where(inside, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    image = color_at(camera.center + rays * z[..., None])
    image[~inside] = 1
    return TrainView(camera, image, inside, ~inside, z.astype(np.float32))


VIEWS = [ball_view(a) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)]


def ball_points(n: int = 300):
    points = np.random.default_rng(0).normal(size=(n, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    return initialise(points.astype(np.float32), (255 * color_at(points)).astype(np.uint8), 4, 0.5)


def same_bytes(a: Gaussians, b: Gaussians) -> bool:
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in PARAMETERS)


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


def test_threads_beside_it_do_not_change_a_byte(native):
    params = TrainParams(iterations=60)
    alone = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1)
    found = {}

    def work(seed: int) -> None:
        found[seed] = train(ball_points(), VIEWS, params=params, extent=1.6, seed=seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found[1].gaussians.means.tobytes() == alone.gaussians.means.tobytes()
    assert found[2].gaussians.means.tobytes() != alone.gaussians.means.tobytes()


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


def test_rates_fall_along_half_a_cosine_to_the_share_that_is_left():
    rates = LearningRates(1.0, 0.01, 2.0, 4.0, 6.0, 8.0, final_share=0.1, fall="cosine")
    others = ("color", "opacity", "scale", "rotation")
    for share, position, left in ((0.0, 1.0, 1.0), (0.25, 0.855, 0.868), (0.5, 0.505, 0.55), (1.0, 0.01, 0.1)):
        now = rates.at(share)
        assert now.position == pytest.approx(position, abs=1e-3)
        for name in others:
            assert getattr(now, name) == pytest.approx(left * getattr(rates, name), rel=1e-3)


def test_the_means_alone_slow_down_in_3dgs():
    rates = LearningRates(1.0, 0.01, 0.1, 0.7, 0.3, 0.9)
    assert rates.at(0.5) == replace(rates, position=pytest.approx(0.1))


def test_colours_above_degree_0_learn_a_twentieth_as_fast():
    rates = LearningRates(1.0, 0.01, 2.0, 4.0, 6.0, 8.0).by_parameter(0.5)
    assert rates == {
        "means": 0.5, "quaternions": 8.0, "log_scales": 6.0, "opacity_logits": 4.0, "sh": 2.0, "sh_rest": 0.1
    }  # fmt: skip


def test_a_step_whose_rates_have_fallen_to_nothing_moves_nothing():
    ball = ball_points()
    params = TrainParams(iterations=1, densify="none", prune_contribution=0.0, prune_opacity=0.0)
    slow = replace(params, rates=LearningRates(final_share=0.0, position_final=0.0, fall="cosine"), iterations=2)
    first, both = (train(ball, VIEWS[:1], params=p, extent=1.6, seed=1).gaussians for p in (params, slow))
    assert same_bytes(first, both)
    assert not same_bytes(first, ball)


@pytest.mark.parametrize(("iterations", "coefficients"), [(19, 1), (20, 9), (29, 9), (30, 16)])
def test_colours_gain_a_degree_every_so_many_steps(iterations, coefficients):
    params = TrainParams(iterations=iterations, sh_degree=3, sh_every=10, densify="none")
    sh = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1).gaussians.sh
    assert sh.shape[1] == coefficients
    used = np.abs(sh).max(axis=(0, 2)) > 0
    assert used.sum() == coefficients  # the last step is the first of the highest degree


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


def test_small_views_are_trained_on_the_cpu_and_large_ones_on_the_device(monkeypatch):
    asked = []
    monkeypatch.setattr(trainer, "device_here", lambda: "cuda")
    monkeypatch.setattr(trainer, "backend_for", lambda device, threads: asked.append(device) or NativeBackend(threads))
    for side in (199, 200):
        view = ball_view(0.0)
        camera = replace(view.camera, width=side, height=side)
        blank = np.zeros((side, side), bool)
        large = TrainView(
            camera, np.zeros((side, side, 3), np.float32), ~blank, blank, np.zeros(blank.shape, np.float32)
        )
        with running(Surroundings(cores=2)):
            train(ball_points(), [large], params=TrainParams(iterations=1), extent=1.6, seed=1)
    assert asked == ["cpu", "cuda"]


@pytest.mark.parametrize(
    ("machine", "own", "small"),
    [(4, 4, 40_000), (16, 2, 40_000), (1, 1, 13_000), (4, 1, 52_000), (16, 1, 208_000)],
)
def test_the_more_trainings_are_at_once_the_larger_are_those_for_the_cpu(monkeypatch, machine, own, small):
    monkeypatch.setattr(trainer, "device_here", lambda: "cuda")
    monkeypatch.setattr(trainer, "usable_cores", lambda: machine)

    def view(pixels: int) -> TrainView:
        camera = Camera(pixels // 100, 100, 60.0, 60.0, 0.0, 0.0, np.eye(4))
        return TrainView(camera, *(np.zeros(0),) * 4)

    with running(Surroundings(cores=own)):
        assert trainer._device([view(small - 1000), view(small)]) == "cpu"
        assert trainer._device([view(small - 1000), view(small + 1000)]) == "cuda"


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


def test_the_number_of_threads_changes_no_byte(native):
    params = TrainParams(iterations=240)
    trained = []
    for cores in (1, 2, 3):
        with running(Surroundings(cores=cores)):
            trained.append(train(ball_points(), VIEWS, params=params, extent=1.6, seed=1))
    assert len(trained[0].gaussians) != 300
    for other in trained[1:]:
        assert all(
            getattr(other.gaussians, name).tobytes() == getattr(trained[0].gaussians, name).tobytes()
            for name in PARAMETERS
        )
        assert other.loss.tobytes() == trained[0].loss.tobytes()


@pytest.mark.parametrize("strategy", ["classic", "none"])
def test_a_training_that_was_interrupted_goes_on_to_the_same_bytes(native, strategy, tmp_path):
    params = TrainParams(iterations=320, densify=strategy, part_weight=0.1, parts_per_step=2)
    parts = [part_view(0, 200, angle) for angle in (0.3, 0.9, 1.8)] if strategy == "none" else []
    alone = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts)

    class Interrupted(Exception):
        pass

    first_steps = []

    def stop_at_150(done, total, note):
        first_steps.append(done)
        if done == 150:
            raise Interrupted

    here = Surroundings(stop_at_150, checkpoint=tmp_path / "kept.npz")
    with running(here), pytest.raises(Interrupted):
        train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts)
    steps = []
    with running(replace(here, listener=lambda done, total, note: steps.append(done))):
        resumed = train(ball_points(), VIEWS, params=params, extent=1.6, seed=1, parts=parts)
    assert steps == [200, 250, 300, 320] and first_steps == [50, 100, 150]
    assert resumed.gaussians.means.tobytes() == alone.gaussians.means.tobytes()
    assert resumed.gaussians.sh.tobytes() == alone.gaussians.sh.tobytes()
    assert resumed.loss.tobytes() == alone.loss.tobytes()


def part_view(start: int, stop: int, angle: float) -> PartView:
    """Of these rows nothing may reach beyond the ball's outline."""
    view = ball_view(angle)
    image = np.zeros_like(view.image)
    empty = replace(view, image=image, inside=np.zeros_like(view.inside))
    return PartView(start, stop, Target.of(empty, Objective(), 0))


def test_what_no_photo_shows_goes_where_it_is_seen_alone_from_the_side(native):
    ball, behind = ball_points(), np.array([[0, 0, 1.3]], np.float32)
    hidden = initialise(np.repeat(behind, 5, axis=0), np.zeros((5, 3), np.uint8), 4, 0.5, opacity=0.9)
    hidden = replace(hidden, log_scales=np.full((5, 3), np.log(0.1), np.float32))
    both, front = concatenate([ball, hidden]), VIEWS[:1]
    params = TrainParams(iterations=150, densify="none", part_weight=0.5, prune_contribution=0.0)
    side = ball_view(np.pi / 2)

    def beside(gaussians) -> float:
        return float(render(gaussians, side.camera).alpha[~side.inside].mean())

    parts = [part_view(0, len(both), np.pi / 2)]
    with_parts = train(both, front, params=params, extent=1.6, seed=1, parts=parts).gaussians
    without = train(both, front, params=replace(params, part_weight=0.0), extent=1.6, seed=1, parts=parts).gaussians
    assert same_bytes(without, train(both, front, params=params, extent=1.6, seed=1).gaussians)
    assert beside(with_parts) < 0.3 * beside(without)


def test_a_part_is_seen_without_the_others_and_moves_them_by_nothing():
    ball = ball_points()
    params = TrainParams(iterations=1, densify="none", part_weight=0.5, prune_contribution=0.0, prune_opacity=0.0)
    alone = train(ball, VIEWS, params=params, extent=1.6, seed=1, parts=[part_view(0, 300, 0.3)]).gaussians
    none = train(ball, VIEWS, params=params, extent=1.6, seed=1).gaussians
    out_of_sight = initialise(np.full((1, 3), 50, np.float32), np.zeros((1, 3), np.uint8), 5, 0.5)
    for both, rows, others in (
        (concatenate([ball, out_of_sight]), slice(0, 300), slice(300, 301)),
        (concatenate([out_of_sight, ball]), slice(1, 301), slice(0, 1)),
    ):
        part = part_view(rows.start, rows.stop, 0.3)
        found = train(both, VIEWS, params=params, extent=1.6, seed=1, parts=[part]).gaussians
        assert same_bytes(select(found, np.arange(len(both))[rows]), alone)
        assert np.array_equal(found.log_scales[others], both.log_scales[others])
    assert not np.array_equal(alone.log_scales, none.log_scales)
    assert np.array_equal(alone.sh, none.sh)  # its colours do not count


def test_a_step_sees_as_many_parts_as_asked_for_one_after_the_other():
    ball, behind = ball_points(), np.array([[0, 0, 1.3]], np.float32)
    hidden = initialise(np.repeat(behind, 5, axis=0), np.zeros((5, 3), np.uint8), 4, 0.5, opacity=0.9)
    both = concatenate([ball, replace(hidden, log_scales=np.full((5, 3), np.log(0.1), np.float32))])
    parts = [part_view(0, 300, 0.3), part_view(300, 305, np.pi / 2)]

    def moved(parts_per_step: int, iterations: int) -> tuple[bool, bool]:
        params = TrainParams(
            iterations=iterations, densify="none", part_weight=0.5, parts_per_step=parts_per_step,
            prune_contribution=0.0, prune_opacity=0.0,
        )  # fmt: skip
        found, without = (
            train(both, VIEWS[:1], params=params, extent=1.6, seed=1, parts=some).gaussians.log_scales
            for some in (parts, [])
        )
        return tuple(not np.array_equal(found[rows], without[rows]) for rows in (slice(300), slice(300, 305)))

    assert sorted(moved(1, 1)) == [False, True]
    assert moved(2, 1) == (True, True) == moved(1, 2)


def test_views_of_parts_need_rows_that_stay():
    with pytest.raises(ValueError, match="densify must be none"):
        train(ball_points(), VIEWS, params=TrainParams(iterations=1), extent=1.6, seed=1, parts=[part_view(0, 9, 0.3)])
