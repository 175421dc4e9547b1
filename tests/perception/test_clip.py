"""CLIP, SigLIP and MaskCLIP against transformers itself, on tiny models of random weights that are saved to
disk."""

import json
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest

from gsjax.methods.protocols import DenseEncoder, LanguageEncoder
from gsjax.perception.clip import ClipEncoder, load_clip
from gsjax.perception.maskclip import MaskClipEncoder
from tests.perception.test_foundation import IMAGE, needs_foundation


class Tensor(np.ndarray):
    """An array with the tensor methods that CLIP's adapter calls."""

    def to(self, device, dtype):
        return self

    def float(self):
        return self

    cpu = numpy = float


def test_crops_are_encoded_a_few_at_a_time_in_their_order():
    """With a stand-in for the model that embeds an image as its mean colour."""
    sizes = []

    def mean_color(pixel_values):
        sizes.append(len(pixel_values))
        return MagicMock(pooler_output=pixel_values.mean(axis=(1, 2)))

    def processor(images, return_tensors):
        return {"pixel_values": np.stack(images).astype(np.float32).view(Tensor)}

    model = MagicMock(get_image_features=mean_color)
    images = list(np.random.default_rng(0).integers(0, 256, (70, 5, 6, 3), dtype=np.uint8))
    found = ClipEncoder(model, processor, None, MagicMock()).embed_images(images)
    wanted = np.stack(images).mean(axis=(1, 2))
    np.testing.assert_allclose(found, wanted / np.linalg.norm(wanted, axis=1, keepdims=True), rtol=1e-5)
    assert sizes == [32, 32, 6]


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory):
    import torch
    from transformers import CLIPConfig, CLIPImageProcessorPil, CLIPModel, CLIPTokenizer

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("clip")
    size = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    letters = "abcdefghijklmnopqrstuvwxyz"
    vocabulary = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    tokens = {word: i for i, word in enumerate(vocabulary)}
    special = {"bos_token_id": tokens["<|startoftext|>"], "eos_token_id": tokens["<|endoftext|>"]}
    config = CLIPConfig(
        text_config={**size, **special, "vocab_size": len(tokens), "max_position_embeddings": 24},
        vision_config={**size, "image_size": 32, "patch_size": 8},
        projection_dim=12,
    )
    CLIPModel(config).save_pretrained(folder)
    (folder / "vocab.json").write_text(json.dumps(tokens))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt")).save_pretrained(folder)
    crop = {"height": 32, "width": 32}
    CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size=crop).save_pretrained(folder)
    return folder


@needs_foundation
def test_clip_agrees_with_transformers(clip_folder):
    import torch
    from transformers import CLIPImageProcessorPil, CLIPModel, CLIPTokenizer

    encoder = load_clip(clip_folder)
    assert isinstance(encoder, LanguageEncoder)
    model = CLIPModel.from_pretrained(clip_folder).eval()
    images = [IMAGE, IMAGE[::-1, :30]]
    pixels = CLIPImageProcessorPil.from_pretrained(clip_folder)(images, return_tensors="pt")
    tokens = CLIPTokenizer.from_pretrained(clip_folder)(["red can"], return_tensors="pt")
    with torch.no_grad():
        wanted = model(**pixels, **tokens)
    np.testing.assert_allclose(encoder.embed_images(images), wanted.image_embeds, atol=1e-5)
    np.testing.assert_allclose(encoder.embed_text("red can"), wanted.text_embeds[0], atol=1e-5)
    cosines = encoder.embed_images(images) @ encoder.embed_text("red can")
    scale = model.logit_scale.exp().item()
    np.testing.assert_allclose(cosines, wanted.logits_per_image[:, 0] / scale, atol=1e-5)


@pytest.fixture(scope="module")
def siglip_folder(tmp_path_factory):
    """A tiny SigLIP of random weights, with a vocabulary learned from a sentence."""
    import sentencepiece
    import torch
    from transformers import SiglipConfig, SiglipImageProcessorPil, SiglipModel, SiglipTokenizer

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("siglip")
    (folder / "words.txt").write_text("a red can stands on the table beside a blue cup\n" * 20)
    sentencepiece.SentencePieceTrainer.train(
        input=str(folder / "words.txt"), model_prefix=str(folder / "spiece"), vocab_size=26, pad_id=3,
        minloglevel=2,
    )  # fmt: skip
    size = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = {**size, "vocab_size": 26, "max_position_embeddings": 12, "projection_size": 16}
    vision = {**size, "image_size": 32, "patch_size": 8}
    model = SiglipModel(SiglipConfig(text_config=text, vision_config=vision))
    model.logit_scale.data[:], model.logit_bias.data[:] = np.log(117.0), -12.9  # as in trained models
    model.save_pretrained(folder)
    SiglipTokenizer(str(folder / "spiece.model")).save_pretrained(folder)
    SiglipImageProcessorPil(size={"height": 32, "width": 32}).save_pretrained(folder)
    return folder


@needs_foundation
def test_siglip_agrees_with_transformers(siglip_folder):
    import torch
    from transformers import SiglipImageProcessorPil, SiglipModel, SiglipTokenizer

    encoder = load_clip(siglip_folder)
    assert isinstance(encoder, LanguageEncoder)
    model = SiglipModel.from_pretrained(siglip_folder).eval()
    pixels = SiglipImageProcessorPil.from_pretrained(siglip_folder)([IMAGE], return_tensors="pt")
    tokenizer = SiglipTokenizer.from_pretrained(siglip_folder)
    tokens = tokenizer(["red can"], padding="max_length", max_length=12, return_tensors="pt")
    with torch.no_grad():
        wanted = model(input_ids=tokens["input_ids"], **pixels)
    (image,), text = encoder.embed_images([IMAGE]), encoder.embed_text("red can")
    np.testing.assert_allclose(image, wanted.image_embeds[0], atol=1e-5)
    np.testing.assert_allclose(text, wanted.text_embeds[0], atol=1e-5)
    np.testing.assert_array_equal(encoder.embed_text("Red CAN"), text)
    chance = 1 / (1 + np.exp(-(117.0 * encoder.min_score - 12.9)))
    np.testing.assert_allclose(chance, 0.01, rtol=1e-4)
    assert encoder.embed_objects(IMAGE, np.zeros(IMAGE.shape[:2], int), 2).shape == (2, 16)
    with pytest.raises(ValueError, match="expected the weights of CLIP, found those of SigLIP"):
        MaskClipEncoder(load_clip(siglip_folder))


@needs_foundation
@pytest.mark.parametrize("model", ["clip", "siglip"])
def test_weights_of_half_precision_are_read_and_on_a_cpu_computed_with_in_single(model, request, tmp_path):
    import shutil

    import torch
    from transformers import AutoModel

    folder = request.getfixturevalue(f"{model}_folder")
    half = shutil.copytree(folder, tmp_path / "half")
    AutoModel.from_pretrained(folder).half().save_pretrained(half)
    single, read = load_clip(folder), load_clip(half)
    assert read.model.dtype == torch.float32
    wanted = single.embed_images([IMAGE])
    np.testing.assert_allclose(read.embed_images([IMAGE]), wanted, atol=2e-3)
    np.testing.assert_allclose(read.embed_text("red can"), single.embed_text("red can"), atol=2e-3)
    assert not np.array_equal(read.embed_images([IMAGE]), wanted)
    # As on a GPU, where weights stay in half precision.
    kept = replace(read, model=read.model.half())
    found = kept.embed_images([IMAGE])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, wanted, atol=1e-2)
    np.testing.assert_allclose(kept.embed_text("red can"), single.embed_text("red can"), atol=1e-2)
    if model == "clip":
        patches = MaskClipEncoder(single, 32)(IMAGE[None])
        np.testing.assert_allclose(MaskClipEncoder(kept, 32)(IMAGE[None]), patches, atol=1e-2)


@needs_foundation
def test_a_model_of_another_kind_is_refused(siglip_folder, tmp_path):
    import shutil

    folder = shutil.copytree(siglip_folder, tmp_path / "other")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"model_type": "siglip2"}))
    with pytest.raises(ValueError, match="expected the model_type clip or siglip, found 'siglip2'"):
        load_clip(folder)


@needs_foundation
def test_clip_sees_a_square_around_each_object(clip_folder):
    encoder = load_clip(clip_folder)
    labels = np.zeros(IMAGE.shape[:2], int)
    labels[10:20, 20:30] = 3
    vectors = encoder.embed_objects(IMAGE, labels, 3)
    assert not vectors[:2].any()
    side, start = 13, (8, 18)  # 10 pixels, and 15% more on each side, rounded up
    crop = IMAGE[start[0] : start[0] + side, start[1] : start[1] + side]
    np.testing.assert_allclose(vectors[2], encoder.embed_images([crop])[0], atol=1e-6)
    with pytest.raises(ValueError, match="expected words that describe an object, found an empty text"):
        encoder.embed_text("  ")


@needs_foundation
def test_maskclip_is_the_values_of_clips_last_layer(clip_folder):
    import torch
    from transformers import CLIPImageProcessorPil, CLIPModel

    encoder = MaskClipEncoder(load_clip(clip_folder), resolution=32)
    assert isinstance(encoder, DenseEncoder)
    found = encoder(np.stack([IMAGE, IMAGE[:, ::-1]]))
    assert found.shape == (2, 4, 6, 12)  # 37 pixels become 32, and 52 become 48, in patches of 8

    model = CLIPModel.from_pretrained(clip_folder).eval()
    size = {"height": 32, "width": 48}
    processor = CLIPImageProcessorPil.from_pretrained(clip_folder)
    pixels = processor([IMAGE], size=size, do_center_crop=False, return_tensors="pt")["pixel_values"]
    with torch.no_grad():
        hidden = model.vision_model(pixels, output_hidden_states=True, interpolate_pos_encoding=True)
    weights = {name: value.numpy() for name, value in model.state_dict().items()}

    def norm(x, name):
        scaled = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    def linear(x, name):
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    last = "vision_model.encoder.layers.1"
    values = linear(norm(hidden.hidden_states[1].numpy(), f"{last}.layer_norm1"), f"{last}.self_attn.v_proj")
    patches = norm(linear(values, f"{last}.self_attn.out_proj"), "vision_model.post_layernorm")[0, 1:]
    vectors = patches @ weights["visual_projection.weight"].T
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    np.testing.assert_allclose(found[0], vectors.reshape(4, 6, 12), atol=1e-5)
    np.testing.assert_array_equal(encoder.embed_text("red can"), encoder.clip.embed_text("red can"))
    assert encoder.min_score == 0.2
