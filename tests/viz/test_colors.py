import numpy as np
import pytest

from gsjax.viz import colors


def test_labels_have_their_colours_and_background_is_grey():
    mask = np.array([[0, 1], [2, -1]])
    picture = colors.colorize_labels(mask)
    assert picture.dtype == np.uint8
    assert tuple(picture[0, 0]) == colors.BACKGROUND
    assert tuple(picture[0, 1]) == colors.label_color(1) == colors.PALETTE[0]
    assert tuple(picture[1, 0]) == colors.label_color(2)
    assert tuple(picture[1, 1]) == colors.INVALID


def test_ten_labels_in_a_row_differ():
    assert len({colors.label_color(label) for label in range(11)}) == 11


def test_palette_stays_apart_for_colour_blind_eyes():
    """Under deuteranopia and protanopia (Vienot et al. 1999, linear RGB) the first labels stay distinct."""
    rgb = (np.array(colors.PALETTE[:6]) / 255) ** 2.2
    deutan = np.array([[0.29275, 0.70725, 0], [0.29275, 0.70725, 0], [-0.02234, 0.02234, 1]])
    protan = np.array([[0.11238, 0.88762, 0], [0.11238, 0.88762, 0], [0.00401, -0.00401, 1]])
    for matrix in (deutan, protan):
        seen = np.clip(rgb @ matrix.T, 0, 1) ** (1 / 2.2)
        gaps = np.linalg.norm(seen[:, None] - seen[None], axis=-1)[~np.eye(6, dtype=bool)]
        assert gaps.min() > 0.08


def test_near_is_brighter_than_far_and_invalid_is_dark():
    depth = np.array([[0.5, 2.0], [0.0, np.nan]], np.float32)
    picture = colors.colorize_depth(depth)
    assert picture[0, 0].sum(dtype=int) > picture[0, 1].sum(dtype=int)
    assert (picture[1] == colors.INVALID).all()


@pytest.mark.parametrize("depth", [np.zeros((2, 3), np.float32), np.ones((2, 3), np.float32)])
def test_depth_without_range_is_drawn(depth):
    assert colors.colorize_depth(depth).shape == (2, 3, 3)


def test_error_is_black_where_equal_and_ignores_what_is_not_finite():
    a = np.zeros((2, 2, 3), np.float32)
    b = a.copy()
    b[0, 0], b[1, 1] = 1.0, np.nan
    picture = colors.error_heatmap(a, b).astype(int).sum(-1)
    assert picture[0, 0] > 500
    assert picture[0, 1] == picture[1, 1] < 10


def test_uint8_and_float_mean_the_same():
    image = np.array([[[0, 51, 255]]], np.uint8)
    np.testing.assert_array_equal(colors.to_uint8(image / 255.0), image)
    assert colors.error_heatmap(image, (image / 255.0).astype(np.float32)).sum() < 10


@pytest.mark.parametrize(
    ("size", "labelled", "expected"),
    [((48, 64), True, (96, 128)), ((64, 48), True, (64, 192)), ((33, 41), False, (34, 124))],
)
def test_panel_is_even_sized_and_holds_every_picture(size, labelled, expected):
    image = np.full((*size, 3), 0.5, np.float32)
    labels = np.ones(size, int) if labelled else None
    panel = colors.side_by_side(image, image, labels=labels)
    assert panel.shape == (*expected, 3)
    assert panel.dtype == np.uint8


def test_panel_does_not_write_into_its_inputs():
    image = np.full((40, 60, 3), 200, np.uint8)
    colors.side_by_side(image, image)
    assert (image == 200).all()


def test_features_that_differ_have_colours_that_differ_and_always_the_same():
    rng = np.random.default_rng(0)
    kinds = rng.normal(size=(3, 12))
    image = kinds[np.arange(60).reshape(6, 10) // 20] + 0.01 * rng.normal(size=(6, 10, 12))
    pca = colors.fit_pca_colors(image.reshape(-1, 12))
    picture = colors.colorize_features(image, pca).astype(int)
    again = colors.fit_pca_colors(image.reshape(-1, 12))
    np.testing.assert_array_equal(picture, colors.colorize_features(image, again))
    means = picture.reshape(3, 20, 3).mean(1)
    assert np.linalg.norm(means[:, None] - means, axis=-1)[~np.eye(3, dtype=bool)].min() > 60
    image[0, 0, 3] = np.nan
    assert tuple(colors.colorize_features(image, pca)[0, 0]) == colors.INVALID


@pytest.mark.parametrize("size", [1, 2])
def test_features_of_few_dimensions_are_drawn(size):
    features = np.linspace(0, 1, 20 * size).reshape(20, size)
    picture = colors.colorize_features(features[None], colors.fit_pca_colors(features))
    assert len(np.unique(picture[..., 0])) > 10
    with pytest.raises(ValueError, match="expected at least one finite feature, found none among 2"):
        colors.fit_pca_colors(np.full((2, size), np.nan))


def test_heat_has_a_scale_on_which_a_value_is_marked():
    dark = np.zeros((240, 320, 3), np.uint8)
    bar = slice(50, 190), slice(-14, -10)
    pictures = [colors.with_heat_scale(dark, -0.5, 1.5, value) for value in (0.0, 1.0, 7.0)]
    assert not dark.any()
    for picture in pictures:
        assert not picture[:, :200].any()
    marked = [np.flatnonzero((picture[bar] == 245).all(axis=(1, 2))) + 50 for picture in pictures]
    np.testing.assert_array_equal(marked[0], 156)  # a quarter of the way up from row 192 to row 48
    np.testing.assert_array_equal(marked[1], 84)
    assert len(marked[2]) == 0
    brightness = pictures[2][bar].sum(axis=-1)[:, 0]
    expected = colors.heat((144 - 1 - np.arange(2, 142))[:, None] / 143)[:, 0].sum(axis=-1)
    np.testing.assert_array_equal(brightness, expected)


def test_what_is_highlighted_keeps_its_colours_and_the_rest_loses_them():
    image = np.full((40, 60, 3), (200, 40, 40), np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[10:30, 10:30] = True
    picture = colors.highlight(image, mask, (0, 255, 0))
    assert tuple(picture[20, 20]) == (200, 40, 40)
    assert np.ptp(picture[5, 50].astype(int)) == 0
    assert picture[10, 20, 1] > 150  # the outline
    assert (image == (200, 40, 40)).all()


def test_a_caption_that_is_too_wide_loses_its_beginning():
    name = "name" * 50
    blank = np.zeros((60, 400, 3), np.uint8)
    short, same, other = (
        colors.captioned(blank, text) for text in (f"{name}1 dB", f"a {name}1 dB", f"{name}2 dB")
    )
    np.testing.assert_array_equal(short, same)
    assert (short != other).any()


def test_labels_have_their_numbers_where_there_is_room():
    labels = np.zeros((240, 320), int)
    labels[40:140, 60:160] = 7
    labels[200:202, 200:300] = 3  # too thin
    plain = np.full((240, 320, 3), 128, np.uint8)
    changed = (colors.numbered(plain, labels) != plain).any(-1)
    rows, columns = np.nonzero(changed)
    assert abs(rows.mean() - 90) < 4
    assert abs(columns.mean() - 110) < 4
    assert (labels[changed] == 7).all()
    np.testing.assert_array_equal(colors.numbered(plain, np.zeros_like(labels)), plain)


@pytest.mark.parametrize("step", [10, 25, 50, 60, 85, 100])
def test_grey_values_that_people_paint_have_colours_of_their_own(step):
    """Labels 100 and 200 once shared a colour, since 10 divides their difference."""
    found = np.array([colors.label_color(label) for label in range(step, 256, step)], float)
    apart = np.linalg.norm(found[:, None] - found, axis=-1) + 1000 * np.eye(len(found))
    assert apart.min() > 25
