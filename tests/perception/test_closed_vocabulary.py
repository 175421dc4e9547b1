import colorsys

import numpy as np
import pytest

from gsjax.methods.protocols import LanguageEncoder
from gsjax.perception.closed_vocabulary import COLORS, ClosedVocabulary, color_words

NAMES = {1: "milk carton", 2: "can", 3: "ball"}
RED, WHITE, YELLOW = (200, 30, 25), (235, 235, 235), (240, 200, 20)


@pytest.fixture(scope="module")
def table():
    """An image of a long red bar, a white square and a small yellow disc, and their labels 1, 2, 3."""
    labels = np.zeros((120, 160), int)
    labels[10:30, 10:110] = 1
    labels[50:80, 20:50] = 2
    y, x = np.mgrid[:120, :160]
    labels[(y - 90) ** 2 + (x - 120) ** 2 < 144] = 3
    return np.array([(120, 90, 60), RED, WHITE, YELLOW], np.uint8)[labels], labels


def ask(vocabulary, table, text):
    """The best label for a text, and whether its score is sufficient."""
    scores = vocabulary.embed_objects(*table, 3) @ vocabulary.embed_text(text)
    return int(scores.argmax()) + 1, bool(scores.max() >= vocabulary.min_score)


@pytest.mark.parametrize(
    ("text", "label"),
    [
        *(("red", 1), ("the white", 2), ("yellow", 3), ("Pick up the largest object, please", 1)),
        *(("round thing", 3), ("sphere", 3), ("a long red one", 1), ("smallest", 3), ("biggest", 1)),
    ],
)
def test_words_find_their_object_without_names(table, text, label):
    assert ask(ClosedVocabulary(), table, text) == (label, True)


@pytest.mark.parametrize(
    ("text", "label"), [("can", 2), ("the white can", 2), ("milk", 1), ("milk carton", 1), ("ball", 3)]
)
def test_names_find_their_object(table, text, label):
    vocabulary = ClosedVocabulary(NAMES)
    assert isinstance(vocabulary, LanguageEncoder)
    assert ask(vocabulary, table, text) == (label, True)


@pytest.mark.parametrize("text", ["red can", "green", "purple ball", "blue milk carton"])
def test_what_is_not_there_is_not_good_enough(table, text):
    assert not ask(ClosedVocabulary(NAMES), table, text)[1]


@pytest.mark.parametrize(
    ("text", "says"), [("red mug", "no word 'mug'.*colors: black"), ("the object", "tells objects apart")]
)
def test_a_word_of_no_vocabulary_is_named_with_all_there_are(text, says):
    with pytest.raises(ValueError, match=says):
        ClosedVocabulary(NAMES).embed_text(text)
    with pytest.raises(ValueError, match="names: milk carton, can, ball"):
        ClosedVocabulary(NAMES).embed_text(text)


def test_longer_names_come_first():
    names = {1: "object 1", 12: "object_12", 3: "red bull"}
    vocabulary = ClosedVocabulary(names)
    labels = np.arange(13)[None].repeat(2, 0)
    objects = vocabulary.embed_objects(np.zeros((2, 13, 3), np.uint8), labels, 12)
    for text, label in [("object 12", 12), ("object 1", 1), ("the red bull", 3)]:
        assert int((objects @ vocabulary.embed_text(text)).argmax()) + 1 == label
    with pytest.raises(ValueError, match="expected distinct names"):
        ClosedVocabulary({1: "can", 2: "Can"})


def test_vectors_are_units_a_full_match_is_the_same_for_any_number_of_words(table):
    vocabulary = ClosedVocabulary(NAMES)
    objects = vocabulary.embed_objects(*table, 4)
    np.testing.assert_allclose(np.linalg.norm(objects, axis=1), [1, 1, 1, 0])
    for text in ("red", "red milk carton", "long red milk carton"):
        vector = vocabulary.embed_text(text)
        assert np.linalg.norm(vector) == pytest.approx(1)
        assert objects[0] @ vector == pytest.approx(1 / np.sqrt(2), abs=0.01)
    assert objects[0] @ vocabulary.embed_text("green milk carton") == pytest.approx(
        0.75 / np.sqrt(2), abs=0.01
    )


def test_every_colour_has_a_word_that_shade_keeps():
    examples = {"black": (8, 8, 8), "white": (240, 240, 238), "grey": (120, 120, 122), "red": (200, 20, 30)}
    examples |= {"orange": (245, 140, 20), "yellow": (245, 215, 30), "green": (40, 150, 60)}
    examples |= {"blue": (35, 80, 190), "purple": (120, 40, 160), "pink": (250, 160, 190)}
    examples |= {"brown": (110, 70, 35)}
    assert tuple(examples) == COLORS
    found = color_words(np.array(list(examples.values()), np.uint8)[None])[0]
    assert [COLORS[i] for i in found] == list(COLORS)
    for name in ("red", "green", "blue"):
        dark = (0.5 * np.array(examples[name])).astype(np.uint8)
        assert COLORS[color_words(dark[None, None])[0, 0]] == name


def test_any_colour_has_some_word():
    hues = np.array(
        [colorsys.hsv_to_rgb(h, s, v) for h in np.linspace(0, 1, 50) for s, v in [(1, 1), (0.5, 0.6)]]
    )
    assert set(np.unique(color_words(hues[None]))) <= set(range(len(COLORS)))


def test_no_objects_have_vectors_of_the_usual_length():
    image, labels, words = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), int), ClosedVocabulary()
    none, one = (words.embed_objects(image, labels, count) for count in (0, 1))
    assert (none.shape, none[:0].shape[1]) == ((0, one.shape[1]), words.embed_text("red").size)


def test_without_sizes_a_thing_is_the_same_in_any_company():
    image, labels = np.zeros((40, 60, 3), np.uint8), np.zeros((40, 60), int)
    image[5:15, 5:15], labels[5:15, 5:15] = (200, 30, 30), 1
    alone = ClosedVocabulary(sizes=False).embed_objects(image, labels, 1)
    image[5:38, 20:58], labels[5:38, 20:58] = (30, 30, 200), 2
    np.testing.assert_allclose(ClosedVocabulary(sizes=False).embed_objects(image, labels, 2)[0], alone[0])
    assert "size" not in ClosedVocabulary(sizes=False).words
    with pytest.raises(ValueError, match="largest"):
        ClosedVocabulary(sizes=False).embed_text("the largest")


@pytest.mark.parametrize("names", [None, {1: "object 1", 2: "object 2"}])
def test_where_nothing_has_a_name_colours_are_advised(names):
    with pytest.raises(ValueError, match=r"no word 'mug'.*No object has a name here.*\"the blue one\""):
        ClosedVocabulary(names).embed_text("mug")
