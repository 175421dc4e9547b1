"""Questions about a synthetic deforming scene with known answers: parsing and answering."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics
from gsjax.methods.deform import (
    QUESTIONS,
    DeformingScene,
    DeformResult,
    LabelledView,
    Meaning,
    PromptedAnswerer,
    TemplatedAnswerer,
    Timeline,
    facts_of_views,
    parse_question,
    question_prompt,
    rows_of,
    scene_facts,
)
from gsjax.methods.deform.answers import main_direction, part_of_picture
from gsjax.methods.protocols import Answerer, LanguageModel
from gsjax.scene.initialize import gaussians_from_points

WIDTH, HEIGHT = 64, 48
K = intrinsics(60.0, WIDTH, HEIGHT)
NAMES = ("tissue", "needle_driver")
FRAMES = (10, 11, 12, 13)
DEEP = 0.1  # depth of the tissue, metres
# The tool in each frame: its middle pixel (column, row) and depth, metres; absent from the first.
TOOL = (None, (10, 8, 0.06), (32, 24, 0.09), (40, 24, 0.099))
ask = TemplatedAnswerer()


def pixels(columns, rows, depth):
    """World points at a depth behind pixels of the camera, which is at the origin."""
    x, y = np.meshgrid(columns, rows)
    ones = np.ones(x.size)
    return depth * np.stack([x.ravel() + 0.5, y.ravel() + 0.5, ones], 1) @ np.linalg.inv(K).T


def made_up(t: int) -> LabelledView:
    """View of frame `t`: a wall of tissue with, except in the first, a tool of 7x7 pixels in front."""
    labels, depths = np.zeros((HEIGHT, WIDTH), np.int32), np.full((HEIGHT, WIDTH), DEEP)
    points = np.full((49, 3), 9.0)
    if (tool := TOOL[t]) is not None:
        column, row, depth = tool
        labels[row - 3 : row + 4, column - 3 : column + 4] = 1
        depths[labels == 1] = depth
        points = pixels(np.arange(column - 3, column + 4), np.arange(row - 3, row + 4), depth)
    labels[40, 50] = 1  # a speck
    wall = pixels(np.arange(WIDTH), np.arange(HEIGHT), DEEP)
    return LabelledView(labels, depths, np.eye(4), K, (wall, points))


@pytest.fixture(scope="module")
def facts():
    times = np.array([0.0, 0.25, 0.5, 1.0])
    return facts_of_views([made_up(t) for t in range(4)], NAMES, FRAMES, times)


class TestAnswers:
    @pytest.mark.parametrize(
        ("question", "value", "unit"),
        [
            ("Is there a needle driver in frame 10?", False, ""),
            ("Is there a needle driver in frame 11?", True, ""),
            ("How many needle drivers are there in frame 10?", 0, ""),
            ("How many needle drivers are there in frame 12?", 1, ""),
            ("Where is the needle driver in frame 11?", "upper left", ""),
            ("Where is the needle driver in frame 12?", "centre", ""),
            ("Where is the needle driver in frame 10?", None, ""),
            ("How deep is the needle driver in frame 12?", 90.0, "mm"),
            ("How deep is the tissue in frame 12?", 100.0, "mm"),
            (
                "Which is nearer to the camera in frame 12, the tissue or the needle driver?",
                "needle_driver",
                "",
            ),
            ("Which is nearer to the camera in frame 10, the tissue or the needle driver?", None, ""),
            ("How far is the needle driver from the tissue in frame 12?", 10.0, "mm"),
            ("Do the tissue and the needle driver touch in frame 12?", False, ""),
            ("Do the tissue and the needle driver touch in frame 13?", True, ""),
            ("Does the tissue touch the needle driver in frame 10?", False, ""),
            ("How far does the tissue move between frames 10 and 13?", 0.0, "mm"),
            ("In which direction does the needle driver move between frames 12 and 13?", "right", ""),
            ("In which direction does the needle driver move between frames 13 and 12?", "left", ""),
            ("In which direction does the needle driver move between frames 11 and 12?", "away", ""),
            ("In which direction does the tissue move between frames 11 and 12?", "still", ""),
            ("In which direction does the needle driver move between frames 10 and 12?", None, ""),
            ("When is the needle driver first seen?", 11, ""),
            ("When is the tissue first seen?", 10, ""),
            ("When is the needle driver fastest?", 11, ""),
            ("When is the needle driver nearest to the camera?", 11, ""),
            ("When do the tissue and the needle driver first touch?", 13, ""),
        ],
    )
    def test_are_those_of_the_made_up_scene(self, facts, question, value, unit):
        found = ask(question, facts)
        assert (found.value, found.unit) == (pytest.approx(value, abs=0.6) if unit else value, unit)
        assert found.text.endswith(".")

    def test_whether_they_touch_is_unknown_without_a_distance(self, facts):
        blind = replace(facts, gaps=np.full_like(facts.gaps, np.nan))
        found = ask("do the tissue and the needle driver touch in frame 12", blind)
        assert found == ("Their distance is not known.", None, "")

    def test_when_is_unknown_of_what_is_seen_but_not_measured(self, facts):
        gaps, depths = (np.full_like(a, np.nan) for a in (facts.gaps, facts.depths))
        blind = replace(facts, gaps=gaps, depths=depths)
        for question in (
            "When do the tissue and the needle driver first touch?",
            "When is the needle driver nearest to the camera?",
        ):
            assert ask(question, blind) == ("It is not known.", None, "")

    def test_a_motion_has_its_true_length(self, facts):
        one, other = (made_up(t).points[1] for t in (12 - 10, 13 - 10))
        found = ask("how far does the needle driver move between frames 12 and 13", facts)
        assert found.value == pytest.approx(1e3 * np.median(np.linalg.norm(one - other, axis=1)))

    def test_direction_is_the_cameras(self, facts):
        """An upside-down camera sees a motion to the right as one to the left."""
        over = np.diag([-1.0, -1.0, 1.0, 1.0])
        turned = [
            s._replace(viewmat=over, labels=s.labels[::-1, ::-1], depths=s.depths[::-1, ::-1])
            for s in map(made_up, range(4))
        ]
        found = facts_of_views(turned, NAMES, FRAMES, np.linspace(0, 1, 4))
        question = "in which direction does the needle driver move between frames 12 and 13"
        assert (ask(question, facts).value, ask(question, found).value) == ("right", "left")
        assert ask("where is the needle driver in frame 11", found).value == "lower right"

    def test_a_scene_of_no_scale_is_measured_in_its_depth(self):
        def scaled(sight, by=7.0):
            return sight._replace(depths=by * sight.depths, points=tuple(by * p for p in sight.points))

        found = facts_of_views(
            [scaled(made_up(t)) for t in range(4)], NAMES, FRAMES, np.linspace(0, 1, 4), metric=False
        )
        answer = ask("how deep is the needle driver in frame 12", found)
        assert answer.value == pytest.approx(90)
        assert answer.unit == "% of the depth"

    @pytest.mark.parametrize(
        ("shift", "word"),
        [
            ((-3, 1, 1), "left"),
            ((0, -3, 1), "up"),
            ((0, 3, 1), "down"),
            ((0, 0, -3), "towards"),
            ((0, 0, 3), "away"),
            ((0.1, 0.2, 0), "still"),
        ],
    )
    def test_words_for_directions(self, shift, word):
        assert main_direction(np.array(shift, float)) == word

    def test_parts_of_the_picture_are_nine(self):
        found = {part_of_picture(x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)}
        assert len(found) == 9
        assert part_of_picture(0.9, 0.1) == "upper right"


class TestParsing:
    @pytest.mark.parametrize("kind", QUESTIONS, ids=lambda kind: kind.name)
    def test_every_example_is_of_its_type(self, kind):
        text = kind.example.split(" (or")[0]
        for name, value in (("X", "tissue"), ("Y", "needle_driver"), ("F", "10"), ("G", "12")):
            text = " ".join(value if word.rstrip("?,") == name else word for word in text.split())
        text = text.replace("between frames 10 and 12", "from frame 10 to frame 12")
        found = parse_question(text, NAMES)
        assert found.kind == kind.name
        assert found.frames == (10, 12)[: kind.frames]
        assert found.things == (0, 1)[: len(found.things)]

    @pytest.mark.parametrize(
        "other",
        [
            "how far apart are tissue and needle driver in frame 12",
            "In frame 12, how far is the TISSUE from the needle_driver ?",
            "What is the distance between the tissue and a needle driver at frame 12?",
        ],
    )
    def test_wording_does_not_matter(self, other):
        assert parse_question(other, NAMES) == parse_question(
            "how far is tissue from needle driver in frame 12", NAMES
        )

    def test_the_camera_is_not_a_class(self):
        assert parse_question("How far is the tissue from the camera in frame 11?", NAMES).kind == "depth"
        assert parse_question("How far away is the tissue in frame 11?", NAMES).kind == "depth"

    @pytest.mark.parametrize(
        ("question", "names", "row"),
        [
            ("Is there a clamp in frame 5?", ("tissue", "clamps"), 1),
            ("How many arteries are there in frame 5?", ("tissue", "artery"), 1),
            ("Is there an artery in frame 5?", ("tissue", "arteries"), 1),
            ("Are there clips in frame 5?", ("clip", "clips"), 1),
            ("Is there a clip in frame 5?", ("clips", "clip"), 1),
        ],
    )
    def test_singular_and_plural_are_one_class_unless_both_are_names(self, question, names, row):
        assert parse_question(question, names).things == (row,)

    def test_names_may_be_parts_of_each_other(self):
        names = ("left lobe", "lobe", "lobe of a lung")
        for row, name in enumerate(names):
            assert parse_question(f"is there {name} in frame 1", names).things == (row,)

    @pytest.mark.parametrize(
        ("question", "words"),
        [
            ("What is the diagnosis?", "expected one of these questions"),
            ("Is there a liver in frame 10?", "found 'liver'; there are: tissue, needle_driver"),
            ("How far is the tissue from the tissue in frame 10?", "two things, found the same one twice"),
            ("Is there tissue?", "expected a frame, found none"),
            ("Does the tissue move?", "expected two frames, found none"),
            ("When is the tissue fastest in frame 10?", "expected no frame, found 1"),
            (
                "Is there tissue in frame 14?",
                "frame 14: expected one of the recording's 4 frames, numbered 10 to 13",
            ),
        ],
    )
    def test_invalid_questions_are_explained(self, facts, question, words):
        with pytest.raises(ValueError, match=words):
            ask(question, facts)

    def test_a_question_without_a_template_lists_all_templates(self, facts):
        with pytest.raises(ValueError, match="expected one of these") as error:
            ask("what is the diagnosis", facts)
        assert all(kind.example in str(error.value) for kind in QUESTIONS)

    def test_which_frames_a_question_needs(self):
        assert rows_of(parse_question("is there tissue in frame 12", NAMES), FRAMES) == [2]
        assert rows_of(parse_question("does tissue move between frame 13 and 11", NAMES), FRAMES) == [3, 1]
        assert rows_of(parse_question("when is tissue fastest", NAMES), FRAMES) == [0, 1, 2, 3]


class TestLanguageModel:
    def test_gets_the_facts_and_the_question(self, facts):
        prompt = question_prompt("Is it safe?", facts)
        assert prompt.endswith("Question: Is it safe?\nAnswer:")
        assert "Frame 10:\n- tissue: 100.0 % of the picture" in prompt
        assert "- needle_driver: not in view" in prompt
        assert " from tissue, moves by (" in prompt
        assert "nan" not in prompt

    def test_answers_by_the_users_function(self, facts):
        prompts = []

        def model(prompt: str) -> str:
            prompts.append(prompt)
            return " As far as is known. \n"

        found = PromptedAnswerer(model)("Is it safe?", facts)
        assert (found.text, found.value) == ("As far as is known.", None)
        assert prompts == [question_prompt("Is it safe?", facts)]
        assert isinstance(model, LanguageModel)
        assert isinstance(ask, Answerer)


@pytest.fixture(scope="module")
def wall():
    """A wall and, in front of it, a plate of 9 by 9 pixels, as Gaussians."""
    wall = pixels(np.arange(-4, WIDTH + 4), np.arange(-4, HEIGHT + 4), DEEP)
    plate = pixels(np.arange(28, 37, 0.5), np.arange(20, 29, 0.5), 0.08)
    points = np.concatenate([wall, plate]).astype(np.float32)
    gaussians = gaussians_from_points(points, np.full_like(points, 0.5))
    codes = np.eye(2, 3)
    features = codes[np.repeat([0, 1], [len(wall), len(plate)])]
    gaussians = eqx.tree_at(
        lambda g: (g.features, g.logit_opacities),
        gaussians,
        (jnp.asarray(features, jnp.float32), jnp.full(len(points), 4.0)),
        is_leaf=lambda leaf: leaf is None,
    )
    camera = (np.eye(4)[None], K[None], (WIDTH, HEIGHT), 0.01)
    timeline = Timeline(np.zeros(1), np.array([10]), 1.0, *camera, np.zeros(0, int))
    return DeformResult(DeformingScene(gaussians), None, Meaning(None, NAMES, codes, np.eye(3)), timeline)


class TestOfAScene:
    @pytest.mark.thorough
    def test_facts_are_what_is_drawn(self, wall):
        found = scene_facts(wall, [0])
        assert found.gaussians.tolist() == [(WIDTH + 8) * (HEIGHT + 8), 18 * 18]
        assert ask("how deep is the needle driver in frame 10", found).value == pytest.approx(80, abs=1)
        assert ask("how deep is the tissue in frame 10", found).value == pytest.approx(100, abs=1)
        assert ask("where is the needle driver in frame 10", found).value == "centre"
        assert ask("how far is tissue from needle driver in frame 10", found).value == pytest.approx(
            20, abs=1.5
        )
        assert 81 <= found.shares[0, 1] * WIDTH * HEIGHT <= 11**2  # at most a pixel wider on each side
        np.testing.assert_allclose(found.shares.sum(), 1, atol=1e-6)
        np.testing.assert_allclose(found.centers[0, 1], (0.4, 0.4, 80), atol=1)

    @pytest.mark.thorough
    def test_a_single_class_is_all_that_is_drawn(self, wall):
        found = scene_facts(replace(wall, meaning=Meaning(None, ("tissue",), np.eye(1, 3), np.eye(3))), [0])
        assert found.gaussians.tolist() == [wall.scene.gaussians.num]
        np.testing.assert_allclose(found.shares, 1)

    def test_without_meaning_there_are_none(self, wall):
        bare = DeformingScene(eqx.tree_at(lambda g: g.features, wall.scene.gaussians, None))
        for result in (replace(wall, meaning=None), replace(wall, scene=bare)):
            with pytest.raises(ValueError, match="features: expected a scene that learned from a teacher"):
                scene_facts(result, [0])
        with pytest.raises(ValueError, match="rows: expected at least one frame"):
            scene_facts(wall, [])


def test_names_match_in_any_spelling():
    names = ("suturing-needle", "st. mark")
    for spelling in ("suturing needle", "suturing-needle", "the Suturing_Needle"):
        assert parse_question(f"where is {spelling} in frame 3?", names).things == (0,)
    assert parse_question("where is st. mark in frame 3?", names).things == (1,)
