"""`gsjax distill` with tiny CLIP, MaskCLIP and SAM models of random weights as teachers."""

from dataclasses import replace

import pytest

from tests.cli.distill.conftest import SMALL, metrics
from tests.perception.test_clip import clip_folder, siglip_folder  # noqa: F401
from tests.perception.test_foundation import needs_foundation, sam_folders  # noqa: F401


@pytest.fixture
def encoders(request, monkeypatch):
    """The options of `gsjax distill` for tiny CLIP and SAM models of random weights."""
    from gsjax.perception import sam

    def unsure(path, load=sam.load_sam):
        return replace(load(path), points_per_side=4, min_score=-9.0, min_stability=-1.0, min_pixels=1)

    monkeypatch.setattr(sam, "load_sam", unsure)
    clip = ("--weights", request.getfixturevalue("clip_folder"))
    return {
        "clip": ("--features", "clip", *clip),
        "siglip": ("--features", "clip", "--weights", request.getfixturevalue("siglip_folder")),
        "second": ("--features", "clip", "--second", "maskclip", *clip),
        "maskclip": ("--features", "maskclip", *clip),
        "sam": ("--features", "closed", "--sam", request.getfixturevalue("sam_folders")[1]),
        "levels": (
            "--features",
            "clip",
            *clip,
            "--sam",
            request.getfixturevalue("sam_folders")[1],
            "--level",
            "each",
        ),
    }


@needs_foundation
@pytest.mark.parametrize(
    ("name", "kind", "masks", "dimension"),
    [
        ("clip", "clip", "files", 12),
        ("siglip", "clip", "files", 16),
        ("second", "clip", "files", 12),
        ("maskclip", "maskclip", "none", 12),
        ("sam", "closed", "sam", 17),
        ("levels", "clip", "sam", 36),
    ],
)
def test_foundation_models_teach(gsjax, pristine, scene, tmp_path, encoders, name, kind, masks, dimension):
    told = ("--images", pristine, "--frames", "0:1", "--eval-cameras", 2, *SMALL, "--distill.iterations", 40)
    code, said = gsjax("distill", scene, "--out", tmp_path / name, *told, *encoders[name])
    assert code == 0, said
    found = metrics(tmp_path / name)
    assert (found["features"], found["masks"], found["dimension"]) == (kind, masks, dimension)
    assert ("MaskCLIP" in found["features_are"] or "patches" in found["features_are"]) == (
        name in ("second", "maskclip")
    )
    losses = [row["cos"] for row in found["curve"] if row["cos"] is not None]  # the first row is of no step
    assert losses[-1] < losses[0]
    assert found["test"]["cosine"] > 0.3
    if kind == "clip":
        code, said = gsjax("query", tmp_path / name, "red can", "--threshold", 0)
        assert code == 0, said
        assert "Loading weights" not in said
        assert (", on level " in said) == (name == "levels")
