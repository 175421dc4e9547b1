"""Adapters against transformers itself, on tiny models with random weights that the tests save to disk."""

import importlib.util
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np
import pytest

from gsjax.extras import MissingExtra
from gsjax.methods.protocols import DenseEncoder, Segmenter
from gsjax.perception.clip import load_clip
from gsjax.perception.dinov2 import load_dinov2
from gsjax.perception.grounded_sam import load_grounded_sam
from gsjax.perception.masks import labels_of_masks
from gsjax.perception.sam import load_sam
from gsjax.perception.sam2 import load_sam2
from gsjax.perception.weights import model_folder

there = all(importlib.util.find_spec(name) for name in ("torch", "transformers"))
needs_foundation = pytest.mark.skipif(
    not there, reason="torch and transformers are not installed: pip install 'gsjax[foundation]'"
)

IMAGE = np.random.default_rng(0).integers(0, 256, (37, 52, 3), dtype=np.uint8)
NORMAL = {"image_mean": [0.5, 0.4, 0.3], "image_std": [0.2, 0.3, 0.4]}


def save_bert_tokenizer(folder):
    from transformers import BertTokenizer

    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "?", "object", "can", "red"]
    (folder / "vocab.txt").write_text("\n".join(words))
    BertTokenizer(str(folder / "vocab.txt")).save_pretrained(folder)


@needs_foundation
@pytest.mark.parametrize("registers", [0, 3])
def test_dinov2_agrees_with_transformers(tmp_path, registers):
    import torch
    from transformers import (
        BitImageProcessorPil,
        Dinov2Config,
        Dinov2Model,
        Dinov2WithRegistersConfig,
        Dinov2WithRegistersModel,
    )

    torch.manual_seed(0)
    size = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 32}
    if registers:
        config = Dinov2WithRegistersConfig(**size, patch_size=8, num_register_tokens=registers)
        model = Dinov2WithRegistersModel(config)
    else:
        model = Dinov2Model(Dinov2Config(**size, patch_size=8))
    model.eval().save_pretrained(tmp_path)
    BitImageProcessorPil(**NORMAL).save_pretrained(tmp_path)

    encoder = load_dinov2(tmp_path, resolution=40)
    assert isinstance(encoder, DenseEncoder)
    images = np.stack([IMAGE, IMAGE[:, ::-1]])
    found = encoder(images)

    # 37 pixels become 40, and 52 become 56: five rows of seven patches.
    exact = BitImageProcessorPil(**NORMAL, size={"height": 40, "width": 56}, do_center_crop=False)
    with torch.no_grad():
        hidden = model(**exact(list(images), return_tensors="pt")).last_hidden_state
    grid = hidden[:, 1 + registers :].reshape(2, 5, 7, 16).permute(0, 3, 1, 2)
    upsampled = torch.nn.Upsample((37, 52), mode="bilinear", align_corners=False)(grid)
    np.testing.assert_allclose(found, upsampled.permute(0, 2, 3, 1), atol=1e-5)


@pytest.fixture(scope="module")
def sam_folders(tmp_path_factory):
    import torch
    from transformers import (
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessorPil,
        SamConfig,
        SamImageProcessorPil,
        SamModel,
    )

    torch.manual_seed(1)
    dino, sam = tmp_path_factory.mktemp("dino"), tmp_path_factory.mktemp("sam")
    text = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    swin = {"embed_dim": 8, "depths": [1, 1, 1], "num_heads": [1, 2, 2], "window_size": 2}
    config = GroundingDinoConfig(
        backbone_config={"model_type": "swin", **swin, "out_features": ["stage2", "stage3"]},
        text_config={"model_type": "bert", "vocab_size": 10, **text},
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        encoder_ffn_dim=16,
        decoder_ffn_dim=16,
        num_queries=6,
        num_feature_levels=3,
    )
    GroundingDinoForObjectDetection(config).save_pretrained(dino)
    GroundingDinoImageProcessorPil(size={"shortest_edge": 64, "longest_edge": 96}).save_pretrained(dino)
    save_bert_tokenizer(dino)
    vision = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "mlp_dim": 16}
    vision |= {"image_size": 64, "patch_size": 8, "output_channels": 8, "num_pos_feats": 4}
    decoder = {"hidden_size": 8, "mlp_dim": 8, "num_attention_heads": 2, "iou_head_hidden_dim": 8}
    prompt = {"hidden_size": 8, "image_size": 64, "patch_size": 8, "image_embedding_size": 8}
    prompt |= {"mask_input_channels": 4}
    SamModel(
        SamConfig(vision_config=vision, mask_decoder_config=decoder, prompt_encoder_config=prompt)
    ).save_pretrained(sam)
    pad = {"height": 64, "width": 64}
    SamImageProcessorPil(size={"longest_edge": 64}, pad_size=pad).save_pretrained(sam)
    return dino, sam


@needs_foundation
def test_grounded_sam_agrees_with_transformers(sam_folders):
    import dataclasses

    import torch
    from transformers import (
        BertTokenizer,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessorPil,
        GroundingDinoProcessor,
        SamImageProcessorPil,
        SamModel,
        SamProcessor,
    )

    dino, sam = sam_folders
    loaded = load_grounded_sam(dino, sam)
    assert isinstance(loaded, Segmenter)
    assert loaded.prompt == "object"
    # Random weights give low scores.
    adapter = dataclasses.replace(loaded, min_box_score=0.0, min_text_score=0.0, min_pixels=1)
    found = adapter.find(IMAGE)

    processor = GroundingDinoProcessor(
        GroundingDinoImageProcessorPil.from_pretrained(dino), BertTokenizer.from_pretrained(dino)
    )
    inputs = processor(images=IMAGE, text=[["object"]], return_tensors="pt")
    with torch.no_grad():
        outputs = GroundingDinoForObjectDetection.from_pretrained(dino).eval()(**inputs)
    wanted = processor.post_process_grounded_object_detection(
        outputs, threshold=0.0, text_threshold=0.0, input_ids=inputs.input_ids, target_sizes=[(37, 52)]
    )[0]
    assert len(found.boxes) == 6
    np.testing.assert_allclose(found.boxes, wanted["boxes"], atol=1e-5)
    np.testing.assert_allclose(found.scores, wanted["scores"], atol=1e-5)

    segment = SamProcessor(SamImageProcessorPil.from_pretrained(sam))
    prompted = segment(IMAGE, input_boxes=[wanted["boxes"].tolist()], return_tensors="pt")
    prompted["input_boxes"] = prompted["input_boxes"].float()
    sizes = prompted["original_sizes"], prompted["reshaped_input_sizes"]
    with torch.no_grad():
        outputs = SamModel.from_pretrained(sam).eval()(
            pixel_values=prompted["pixel_values"],
            input_boxes=prompted["input_boxes"],
            multimask_output=False,
        )
    masks = segment.image_processor.post_process_masks(outputs.pred_masks, *sizes)[0][:, 0].numpy()
    assert 0 < masks.mean() < 1
    np.testing.assert_array_equal(found.masks, masks)
    labels = adapter(IMAGE)
    assert labels.shape == (37, 52)
    assert ((labels > 0) <= masks.any(0)).all()


@needs_foundation
def test_grounded_sam_that_finds_nothing_labels_nothing(sam_folders):
    import dataclasses

    adapter = dataclasses.replace(load_grounded_sam(*sam_folders), min_box_score=1.0)
    assert not adapter(IMAGE).any()


def test_of_two_masks_the_smaller_is_on_top_and_doubles_are_dropped():
    masks = np.zeros((5, 20, 20), bool)
    masks[0, 2:12, 2:12] = True  # a tray
    masks[1, 4:8, 4:8] = True  # an object in it
    masks[2, 4:8, 4:9] = True  # the same object again, with a lower score
    masks[3] = True  # the table
    scores = np.array([0.6, 0.9, 0.5, 0.99, 0.8])  # the last mask is empty
    labels = labels_of_masks(masks, scores, max_fraction=0.5, max_overlap=0.7)
    assert np.unique(labels).tolist() == [0, 1, 2]
    assert (labels[4:8, 4:8] == 2).all()
    assert (labels > 0).sum() == 100


LOADERS = [load_clip, load_dinov2, load_sam, load_sam2, lambda path: load_grounded_sam(path, path)]


@pytest.mark.parametrize("load", LOADERS)
def test_a_wrong_path_says_what_was_expected_and_how_to_get_it(load, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere: expected a folder of .*config\.json.*hf download"):
        load(tmp_path / "nowhere")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"it lacks model\.safetensors or .*found config\.json"):
        load(tmp_path)


def save_placeholders(folder, *names):
    for name in ("config.json", "preprocessor_config.json", "tokenizer.json", *names):
        (folder / name).write_text('{"model_type": "clip"}' if name == "config.json" else "{}")


@pytest.mark.parametrize("load", LOADERS)
def test_pickled_weights_are_refused_with_advice_on_how_to_convert_them(load, tmp_path):
    save_placeholders(tmp_path, "pytorch_model.bin")
    with pytest.raises(
        FileNotFoundError,
        match=r"it lacks model\.safetensors .* pytorch_model\.bin is a pickle.*weights_only=True.*save_file",
    ):
        load(tmp_path)


@pytest.mark.parametrize(
    ("name", "holds", "says"),
    [
        ("config.json", '{"transformers_weights": "adapter_model.bin"}', "expected no transformers_weights"),
        ("config.json", "[]", "expected a JSON object, found list"),
        ("config.json", "{", "expected JSON, found"),
        ("adapter_config.json", "{}", "expected the weights of a whole model, found only an adapter"),
        (
            "model.safetensors.index.json",
            '{"weight_map": {"a": "a.bin"}}',
            r"expected a weight_map that names .* found none",
        ),
        ("model.safetensors.index.json", "{}", r"expected a weight_map that names .* found none"),
    ],
)
def test_files_that_lead_to_a_pickle_are_refused(tmp_path, name, holds, says):
    save_placeholders(tmp_path, "model.safetensors.index.json")
    (tmp_path / "model.safetensors.index.json").write_text('{"weight_map": {"a": "a.safetensors"}}')
    assert model_folder(tmp_path, "CLIP's weights", (), "a/b") == tmp_path
    (tmp_path / name).write_text(holds)
    with pytest.raises(ValueError, match=rf"{name}: {says}"):
        model_folder(tmp_path, "CLIP's weights", (), "a/b")


@pytest.mark.parametrize("load", LOADERS)
def test_transformers_is_asked_to_unpickle_and_to_run_nothing(load, tmp_path, monkeypatch):
    save_placeholders(tmp_path, "model.safetensors")
    modules = __import__("sys").modules
    for name in ("torch", "transformers"):
        module = ModuleType(name)
        module.__getattr__ = MagicMock()  # PEP 562: any attribute
        monkeypatch.setitem(modules, name, module)
    load(tmp_path)
    accessed = modules["transformers"].__getattr__
    loads = [call for call in accessed.return_value.mock_calls if call[0] == "from_pretrained"]
    assert all(options["local_files_only"] is True for _, _, options in loads)
    models = [
        call.args[0] for call in accessed.call_args_list if "Model" in call.args[0] or "For" in call.args[0]
    ]
    safe = [options for _, _, options in loads if options.get("use_safetensors") is True]
    assert len(safe) == len(models) > 0
    autos = [call.args[0] for call in accessed.call_args_list if call.args[0].startswith("Auto")]
    assert sum(options.get("trust_remote_code") is False for _, _, options in loads) >= len(autos)


@pytest.mark.parametrize("load", LOADERS)
def test_without_the_extra_it_is_named(load, tmp_path, monkeypatch):
    save_placeholders(tmp_path, "model.safetensors")
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    with pytest.raises(
        MissingExtra, match=r"torch, which is not installed: \S+ -m pip install 'gsjax\[foundation\]'"
    ):
        load(tmp_path)
