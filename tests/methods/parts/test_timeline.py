"""Films made by edit scripts: the edits are applied in order, and the film is as long as they need."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.parts import edits
from gsjax.methods.parts.film import Layer, film_gaussians
from gsjax.methods.parts.operations import (
    Amplify,
    Composite,
    Echo,
    Fade,
    Freeze,
    Ghost,
    Isolate,
    Loop,
    Move,
    Place,
    Redirect,
    Rotate,
    Scale,
    Speed,
)
from gsjax.methods.parts.timeline import Script, apply, parse_script
from gsjax.methods.parts.trajectory import PartScene
from tests.methods.parts.made_up_parts import STEP, assert_same, rows, scene_of, trajectory
from tests.methods.parts.test_scripts import EXAMPLE

NAMES = {"drawer": 1, "lid": 2, "faucet": 3}
gaussians_then = jax.jit(film_gaussians)


def layer_of(seed=0, moments=9, start=0.0):
    """A layer of four parts with hard weights, from 0 to 1 s by default."""
    scene = scene_of(seed, num=8, parts=4)
    weights = jnp.asarray(np.eye(4)[np.arange(8) % 4], jnp.float32)
    scene = PartScene(scene.gaussians, weights, scene.centers)
    one = trajectory(seed, moments)
    return Layer(scene, replace(one, times=jnp.asarray(np.asarray(one.times) + start, jnp.float32)))


def film_of(*script, layer=None, load_scene=None, **options):
    return apply(Script(edits=script, **options), layer or layer_of(), NAMES, load_scene)


def shows(film, part, indices, layer=None):
    """Asserts that a part shows these moments of the recording, to the bit."""
    found = film[0].trajectory
    assert len(found.times) == len(indices)
    assert_same(
        rows(found, [part], range(len(indices))), rows((layer or layer_of()).trajectory, [part], indices)
    )


class TestLength:
    def test_a_film_begins_at_0_and_lasts_as_long_as_the_recording(self):
        film = film_of(layer=layer_of(start=7.25))
        np.testing.assert_array_equal(film[0].trajectory.times, STEP * np.arange(9))

    @pytest.mark.parametrize(
        ("edit", "moments"),
        [
            (Speed(parts=(1,), factor=0.5), 17),  # the last moment, at 1 s, is shown at 2 s
            (Speed(parts=(1,), factor=2.0), 9),  # the others go on
            (Speed(parts=("all",), factor=2.0), 5),
            (Speed(parts=("all",), factor=-4.0), 3),
            (Speed(parts=(1,), factor=0.5, begin=0.5, end=0.75), 11),
            (Loop(parts=(1,), begin=0.5, end=0.75, times=3), 13),
            (Loop(parts=(1,), times=2), 17),
            (Loop(parts=(1,), times=2, bounce=True), 33),
            (Loop(parts=(1,), begin=0.5, end=0.75, times=1, bounce=True), 13),
            (Loop(parts=(1,)), 9),
            (Freeze(parts=(1,), at=0.5), 9),
            (Freeze(parts=(1,), begin=0.25, end=0.75), 13),
            (Freeze(parts=(1,), at=0.875, begin=0.25, end=0.75), 9),
            (Isolate(parts=(1,), begin=0.25, end=0.75), 13),
            (Echo(parts=(1,), copies=2, every=0.25), 13),  # the last copy ends at 1.5 s
            (Echo(parts=(1,), copies=2, every=0.25, end=1.25), 11),
            (Echo(parts=(1,), copies=2, every=0.25, end=0.5), 9),
            (Echo(parts=(1,), copies=2, every=-0.25), 9),
        ],
    )
    def test_a_film_is_as_long_as_edits_need_it(self, edit, moments):
        assert len(film_of(edit)[0].trajectory.times) == moments

    @pytest.mark.parametrize(
        "edit",
        [
            Speed(parts=(1,), factor=0.5),
            Speed(parts=(1,), factor=-0.5),
            Loop(parts=(1,), begin=0.25, end=0.5, times=3),
            Loop(parts=(1,), times=2, bounce=True),
            Freeze(parts=(1,), begin=0.25, end=0.75),
        ],
    )
    def test_and_no_longer(self, edit):
        """The part still moves at the end of the film."""
        before, last = np.asarray(film_of(edit)[0].trajectory.poses.quats)[-2:, 1]
        assert np.abs(last - before).max() > 1e-3

    def test_copies_are_seen_to_their_end(self):
        film = film_of(Echo(parts=(1,), copies=2, every=0.25))
        found, recorded = (np.asarray(of.trajectory.poses.quats)[:, 1] for of in (film[2], layer_of()))
        np.testing.assert_array_equal(found, recorded[[0] * 4 + [*range(9)]])

    def test_of_copies_the_scene_itself_knows_nothing(self):
        """Echoes that last longer do not change where the part itself ends: it plays backwards from there."""
        shows(
            film_of(Echo(parts=(1,), copies=2, every=0.25), Speed(parts=(1,), factor=-1), length=1),
            1,
            range(8, 0, -1),
        )

    def test_length_and_fps_say_otherwise(self):
        for options, times in (
            ({"length": 0.5}, STEP * np.arange(4)),
            ({"length": 1.5}, STEP * np.arange(12)),
            ({"fps": 16}, np.arange(17) / 16),
            ({"fps": 15, "length": 2}, np.arange(30) / 15),
        ):
            film = film_of(**options)
            np.testing.assert_allclose(film[0].trajectory.times, times, atol=1e-6)

    def test_between_moments_of_the_recording_it_is_as_at_times_has_it(self):
        found = film_of(fps=15)[0].trajectory
        assert_same(found, edits.at_times(layer_of().trajectory, found.times), atol=1e-6)

    def test_what_is_slowed_down_and_sped_up_again_has_lost_nothing(self):
        """Between the two edits it is longer than the resulting film."""
        film = film_of(Speed(parts=(1,), factor=0.5), Speed(parts=(1,), factor=2.0))
        shows(film, 1, range(9))

    def test_one_moment_needs_fps(self):
        with pytest.raises(
            ValueError, match="fps: expected a frame rate, as the recording has only one frame"
        ):
            film_of(layer=layer_of(moments=1))
        assert len(film_of(layer=layer_of(moments=1), fps=10, length=1)[0].trajectory.times) == 10

    def test_a_slip_does_not_fill_the_memory(self):
        with pytest.raises(
            ValueError, match=r"length: expected at most 100000 moments after each edit, found 86400 s at 15 "
        ):
            film_of(length=86400, fps=15)
        with pytest.raises(ValueError, match="length: expected at most 100000 moments"):
            film_of(*[Loop(parts=(1,), times=1000)] * 2, length=1)

    def test_another_length_compiles_nothing_anew(self):
        def film(factor):
            return film_of(Speed(parts=(1,), factor=factor), Move(parts=(2,), by=(1, 0, 0)))

        film(0.5)
        sizes = edits.at_times._cache_size()
        assert [len(film(factor)[0].trajectory.times) for factor in (0.4, 0.25)] == [21, 33]
        assert edits.at_times._cache_size() == sizes


class TestFilms:
    def test_no_edits_change_nothing(self):
        film = film_of()
        assert len(film) == 1
        for part in range(4):
            shows(film, part, range(9))

    def test_time_edits_follow_each_other(self):
        """An edit applies to what the edits before it have made of the part, including its new end."""
        film = film_of(
            Freeze(parts=("drawer",), begin=0.25, end=0.5),
            Speed(parts=("drawer",), factor=-1),
            Speed(parts=("lid",), factor=-1),
        )
        shows(film, 1, [8, 7, 6, 5, 4, 3, 2, 2, 2, 1, 0])
        shows(film, 2, [8, 7, 6, 5, 4, 3, 2, 1, 0, 0, 0])
        shows(film, 3, [0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8])

    @pytest.mark.parametrize("edit", [Speed, Loop])
    def test_what_is_over_stands_still_whatever_is_done_to_all(self, edit):
        """The drawer has stopped at 0.25 s, when the other parts begin to go backwards."""
        keys = {"factor": -1} if edit is Speed else {"bounce": True, "times": 1}
        first = Speed(parts=("drawer",), factor=4)
        film = film_of(first, edit(parts=("all",), begin=0.25, **keys), length=1.125)
        alone = film_of(edit(parts=("lid",), begin=0.25, **keys), length=1.125)
        shows(film, 1, [0, 4, 8, 8, 8, 8, 8, 8, 8])
        assert_same(rows(film[0].trajectory, [2], range(9)), rows(alone[0].trajectory, [2], range(9)))

    def test_it_is_an_error_only_if_none_of_them_moves(self):
        first = Speed(parts=("drawer", "lid"), factor=4)
        then = {"factor": 2, "begin": 0.5}
        assert len(film_of(first, Speed(parts=("all",), **then))[0].trajectory.times) == 7
        with pytest.raises(
            ValueError, match=r"edit 2 \(speed\): from: .* before 0\.25, .* of lid, part 1 ends, found"
        ):
            film_of(first, Speed(parts=("lid", 1), **then))

    def test_a_loop_fills_the_film(self):
        shows(film_of(Loop(parts=(2,)), length=2.5), 2, [*range(8), *range(8), *range(4)])

    def test_a_loop_without_a_seam_ends_where_it_began(self):
        shows(
            film_of(Loop(parts=(2,), times=1, bounce=True), length=2.5),
            2,
            [*range(9), *range(7, -1, -1), 0, 0, 0],
        )

    def test_isolate_and_ghost_are_of_the_others(self):
        film = film_of(Isolate(parts=("lid",)), Ghost(parts=("lid", "background"), opacity=0.5))
        before, after = jax.device_get((layer_of().trajectory, film[0].trajectory))
        assert_same(after.poses.quats[:, 2], before.poses.quats[:, 2])
        for p in (0, 1, 3):
            assert_same(after.poses.quats[:, p], np.tile(before.poses.quats[0, p], (9, 1)))
        np.testing.assert_allclose(after.opacities[:, 1], before.opacities[[0] * 9, 1] * 0.5, rtol=1e-6)
        assert_same(after.opacities[:, 2], before.opacities[:, 2])

    @pytest.mark.parametrize(
        ("edit", "expected"),
        [
            (Fade(parts=(1,), opacity=0.2), lambda t, _: edits.fade(t, [1], 0.2)),
            (Scale(parts=(1,), factor=3), lambda t, _: edits.scale(t, [1], 3.0)),
            (Move(parts=(1,), by=(1, 2, 3)), lambda t, _: edits.move(t, [1], jnp.array([1.0, 2.0, 3.0]))),
            (Amplify(parts=(1,), factor=2, at=0.5), lambda t, _: edits.amplify(t, [1], 2.0, 0.5)),
            (
                Rotate(parts=(1, 2), axis=(0, 3, 0), degrees=90, about=(1, 1, 0)),
                lambda t, arms: edits.rotate(t, [1, 2], jnp.array([0, jnp.pi / 2, 0]), arms),
            ),
            (
                Redirect(parts=(1, 2), axis=(0, 3, 0), degrees=90, about=(1, 1, 0), at=0.25),
                lambda t, arms: edits.redirect(t, [1, 2], jnp.array([0, jnp.pi / 2, 0]), arms, 0.25),
            ),
            (
                Fade(parts=(1,), begin=0.25, end=0.75, ease=0.25),
                lambda t, _: edits.fade(t, [1], 0.0, edits.during(t.times, 0.25, 0.75, 0.25)),
            ),
        ],
    )
    def test_operations_are_the_functions_in_degrees_metres_and_seconds(self, edit, expected):
        layer = layer_of()
        arms = jnp.asarray([1.0, 1.0, 0.0] - np.asarray(layer.scene.centers)[1:3])
        assert_same(film_of(edit)[0].trajectory, expected(layer.trajectory, arms), atol=1e-5)

    def test_order_matters_where_it_should(self):
        shift = (0.0, 0.0, 0.5)
        first = film_of(Move(parts=(1,), by=shift, begin=0.5), Speed(parts=(1,), factor=-1))
        then = film_of(Speed(parts=(1,), factor=-1), Move(parts=(1,), by=shift, begin=0.5))
        layers = first[0], then[0], layer_of()
        first, then, plain = (np.asarray(of.trajectory.poses.translations)[:, 1, 2] for of in layers)
        np.testing.assert_allclose(first - plain[::-1], [0.5] * 5 + [0] * 4, atol=1e-6)
        np.testing.assert_allclose(then - plain[::-1], [0] * 4 + [0.5] * 5, atol=1e-6)

    def test_echo_adds_layers_of_the_part_alone(self):
        film = film_of(Echo(parts=("faucet",), copies=2, every=0.25, fade=0.5, begin=0.5), length=1.125)
        assert [layer.scene.gaussians.num for layer in film] == [8, 2, 2]
        opacities = np.asarray(layer_of().trajectory.opacities[:, 3])
        first, second = (np.asarray(layer.trajectory.opacities[:, 3]) for layer in film[1:])
        np.testing.assert_allclose(first, [0] * 4 + list(0.5 * opacities[2:7]), rtol=1e-6)
        np.testing.assert_allclose(second, [0] * 4 + list(0.25 * opacities[0:5]), rtol=1e-6)

    def test_a_part_that_vanishes_costs_nothing(self):
        film = film_of(Fade(parts=("drawer",)))
        assert film[0].scene.gaussians.num == 6
        assert not np.isin(film[0].scene.labels, 1).any()

    @pytest.mark.parametrize(
        ("edit", "message"),
        [
            (
                Fade(parts=("drawr",)),
                "edit 2 (fade): parts: expected one of background (0), drawer (1), lid (2), ",
            ),
            (Fade(parts=("drawr",)), "found 'drawr'; did you mean 'drawer'?"),
            (Fade(parts=(4,)), "edit 2 (fade): parts: expected numbers from 0 to 3, found 4"),
            (
                Speed(parts=(1,), factor=2, begin=1.5),
                "edit 2 (speed): from: expected a time before 1, where the motion of part 1 ends, found 1.5",
            ),
            (Loop(parts=(1,), begin=1), "edit 2 (loop): from: expected a time before 1"),
            (
                Freeze(parts=(1,), at=0.5, end=0.5),
                "edit 2 (freeze): to: expected a time after 0.5, when parts stop",
            ),
            (Composite(parts=(1,), from_run="x"), "edit 2 (composite): from_run: expected load_scene"),
        ],
    )
    def test_what_does_not_fit_the_scene_is_said_with_its_place(self, edit, message):
        with pytest.raises(ValueError) as error:  # noqa: PT011
            film_of(Fade(parts=(1,)), edit)
        assert message in str(error.value)


class TestComposite:
    def load(self, path):
        assert path == "elsewhere"
        return layer_of(5, moments=5, start=3.0), {"cup": 1, "hand": 2}

    def film(self, **keys):
        return film_of(Composite(parts=("cup",), from_run="elsewhere", **keys), load_scene=self.load)

    @pytest.mark.thorough
    def test_parts_of_another_run_are_brought_in(self):
        film = self.film()
        assert [layer.scene.gaussians.num for layer in film] == [8, 2]
        layers = film[1], self.load("elsewhere")[0]
        found, other = (np.asarray(layer.trajectory.opacities)[:, 1] for layer in layers)
        assert_same(found, other[[0, 1, 2, 3, 4, 4, 4, 4, 4]])
        assert gaussians_then(film, 7).num == 10

    def test_they_are_edited_on_their_own(self):
        film = self.film(
            edits=(Speed(parts=("cup",), factor=-1), Echo(parts=("hand",), copies=1, every=0.125))
        )
        assert len(film) == 3
        layers = film[1], self.load("elsewhere")[0]
        found, other = (np.asarray(layer.trajectory.opacities)[:, 1] for layer in layers)
        np.testing.assert_allclose(found, other[[4, 3, 2, 1, 0, 0, 0, 0, 0]], rtol=1e-6)
        np.testing.assert_array_equal(np.asarray(film[2].scene.labels), 2)

    def test_they_come_to_their_place(self):
        """The handle starts at the given place, and offsets from it are rotated and halved."""
        place = Place(to=(1, 2, 3), axis=(0, 0, 1), degrees=90, scale=0.5)
        plain, there = jax.device_get((self.film()[1], self.film(place=place)[1]))
        start = gaussians_then((plain,), 0).means
        handle = plain.scene.centers[1] + plain.trajectory.poses.translations[0, 1]
        offset = np.asarray(start) - handle
        turned = np.stack([-offset[:, 1], offset[:, 0], offset[:, 2]], axis=1)
        found = gaussians_then((there,), 0).means
        np.testing.assert_allclose(found, np.array([1, 2, 3]) + 0.5 * turned, atol=1e-5)

    def test_they_may_come_for_a_while(self):
        film = self.film(begin=0.5, end=0.75)
        shown = np.asarray(film[1].trajectory.opacities[:, 1]) > 0
        np.testing.assert_array_equal(shown, [0, 0, 0, 0, 1, 1, 0, 0, 0])

    @pytest.mark.parametrize(
        ("keys", "moments"),
        [
            ({}, 9),  # 0.5 s of another run, in a film of 1 s
            ({"edits": (Speed(parts=("cup",), factor=0.25),)}, 17),
            ({"edits": (Speed(parts=("cup",), factor=0.25),), "end": 1.5}, 13),
            ({"edits": (Speed(parts=("hand",), factor=0.25),)}, 9),  # not part of the composite
            ({"edits": (Echo(parts=("hand",), copies=1, every=0.75),)}, 11),  # but its copy is
            (
                {"edits": (Composite(parts=(1,), from_run="elsewhere", edits=(Loop(parts=(1,), times=4),)),)},
                17,
            ),
        ],
    )
    def test_they_are_seen_to_the_end_of_their_motion(self, keys, moments):
        film = self.film(**keys)
        assert [len(layer.trajectory.times) for layer in film] == [moments] * len(film)

    def test_a_run_that_is_longer_is_seen_to_its_end_too(self):
        longer = layer_of(5, moments=13)
        film = film_of(Composite(parts=(1,), from_run="x"), load_scene=lambda path: (longer, NAMES))
        found, other = (np.asarray(layer.trajectory.opacities)[:, 1] for layer in (film[1], longer))
        np.testing.assert_allclose(found, other, rtol=1e-6)

    def test_a_part_is_looked_up_there(self):
        with pytest.raises(
            ValueError, match=r"edit 1 \(composite\): parts: expected one of background \(0\), cup"
        ):
            film_of(Composite(parts=("lid",), from_run="elsewhere"), load_scene=self.load)

    def test_what_is_wrong_there_is_said_with_its_place(self):
        with pytest.raises(
            ValueError, match=r"edit 1 \(composite\): edit 1 \(fade\): parts: expected one of"
        ):
            self.film(edits=(Fade(parts=("lid",)),))


def test_the_example_makes_a_film_that_can_be_drawn():
    script = parse_script(EXAMPLE)
    film = apply(script, layer_of(), NAMES, lambda path: (layer_of(5), {"cup": 1}))
    assert len(film) == 4
    for t in (0, 15):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians_then(film, t)))
