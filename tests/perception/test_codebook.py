"""Every class name has a vector of its own, nearly orthogonal to all others."""

import numpy as np
import pytest

from gsjax.methods.protocols import LanguageEncoder
from gsjax.perception.codebook import DIMENSION, ClassCodebook, distinct_names

NAMES = {1: "drawer", 2: "laptop_lid", 4: "Faucet Handle"}
LABELS = np.array([[0, 1, 1], [2, 4, 3]])


def test_objects_have_the_vectors_of_their_names():
    encoder = ClassCodebook(NAMES)
    assert isinstance(encoder, LanguageEncoder)
    rows = encoder.embed_objects(np.zeros((2, 3, 3)), LABELS, 5)
    assert rows.shape == (5, DIMENSION)
    np.testing.assert_array_equal(rows[1], encoder.embed_text("Laptop Lid"))
    np.testing.assert_array_equal(rows[3], encoder.embed_text("faucet_handle"))
    np.testing.assert_array_equal(rows[[2, 4]], 0)  # one without a name, one without pixels
    cosines = rows[[0, 1, 3]] @ rows[[0, 1, 3]].T
    np.testing.assert_allclose(np.diag(cosines), 1, atol=1e-6)
    assert np.abs(cosines - np.eye(3)).max() < 0.2


def test_a_name_has_the_same_vector_wherever_it_occurs():
    one, other = ClassCodebook({1: "can", 2: "milk"}), ClassCodebook({7: "milk"})
    np.testing.assert_array_equal(one.embed_text("milk"), other.embed_text("Milk"))


def test_an_unknown_name_is_an_error():
    with pytest.raises(
        ValueError, match=r"no class 'fridge'; .* only names: drawer, laptop lid, faucet handle\."
    ):
        ClassCodebook(NAMES).embed_text("fridge")
    with pytest.raises(ValueError, match="expected distinct names"):
        ClassCodebook({1: "Box", 2: "box"})
    with pytest.raises(ValueError, match="names: expected a name for at least one label, found none"):
        ClassCodebook({})


@pytest.mark.parametrize(
    ("names", "distinct"),
    [
        ({3: "cup"}, {0: "tissue", 3: "cup"}),
        ({0: "wall", 3: "cup"}, {0: "wall", 3: "cup"}),
        ({3: "cup", 5: "Cup"}, {0: "tissue", 3: "cup (3)", 5: "Cup (5)"}),
        ({1: "cup 1", 2: "cup_1"}, {0: "tissue", 1: "cup 1 (1)", 2: "cup_1 (2)"}),
        ({3: "cup", 5: "cup", 7: "cup (3)"}, {0: "tissue", 3: "cup (3) (3)", 5: "cup (5)", 7: "cup (3) (7)"}),
        ({1: "Tissue."}, {0: "background", 1: "Tissue."}),
        ({1: "tissue", 2: "_background_"}, {0: "tissue (0)", 1: "tissue (1)", 2: "_background_"}),
    ],
)
def test_names_are_made_distinct_and_label_0_takes_one_that_is_free(names, distinct):
    assert distinct_names(names, ("tissue", "background")) == distinct
    assert len(ClassCodebook(distinct).names) == len(distinct)
