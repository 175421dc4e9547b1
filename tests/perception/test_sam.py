"""SAM and SAM2 against transformers itself, on tiny models with random weights that the tests save."""

import dataclasses
import importlib.util
import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsjax.methods.protocols import Propagator, Segmenter
from gsjax.perception.sam import SamSegmenter, load_sam
from gsjax.perception.sam2 import Sam2Propagator, load_sam2

there = all(importlib.util.find_spec(name) for name in ("torch", "transformers"))
needs_foundation = pytest.mark.skipif(
    not there, reason="torch and transformers are not installed: pip install 'gsjax[foundation]'"
)
needs_torchvision = pytest.mark.skipif(
    not (there and importlib.util.find_spec("torchvision")),
    reason="the whole pipelines of transformers need torchvision, which gsjax does not",
)

HEIGHT, WIDTH, SIDE = 37, 52, 64
IMAGE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
MEAN, STD = [0.5, 0.4, 0.3], [0.2, 0.3, 0.4]


def greedy_suppression(boxes, scores, max_overlap):
    """Returns the rows left by non-maximum suppression of boxes, from the highest score on."""
    left, kept = list(np.argsort(-scores, kind="stable")), []
    while left:
        best = left.pop(0)
        kept.append(best)
        low = np.maximum(boxes[left, :2], boxes[best, :2])
        high = np.minimum(boxes[left, 2:], boxes[best, 2:])
        both = np.prod(np.maximum(high - low, 0), axis=1)
        areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
        overlaps = both / (areas[left] + areas[best] - both)
        left = [row for row, overlap in zip(left, overlaps, strict=True) if overlap <= max_overlap]
    return kept


@pytest.fixture(scope="module")
def sam_folder(tmp_path_factory):
    import torch
    from transformers import SamConfig, SamImageProcessorPil, SamModel

    folder = tmp_path_factory.mktemp("sam")
    vision = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "mlp_dim": 16}
    vision |= {"image_size": SIDE, "patch_size": 8, "output_channels": 8, "num_pos_feats": 4}
    decoder = {"hidden_size": 8, "mlp_dim": 8, "num_attention_heads": 2, "iou_head_hidden_dim": 8}
    prompt = {"hidden_size": 8, "image_size": SIDE, "patch_size": 8, "image_embedding_size": 8}
    prompt |= {"mask_input_channels": 4}
    model = SamModel(
        SamConfig(vision_config=vision, mask_decoder_config=decoder, prompt_encoder_config=prompt)
    )
    torch.manual_seed(7)  # with most other seeds, all masks are as large as the image
    for weights in model.parameters():
        if weights.ndim > 1:
            torch.nn.init.normal_(weights, std=0.6)
    for answers in model.mask_decoder.output_hypernetworks_mlps:
        answers.proj_out.weight.data.mul_(30.0)  # some masks must be stable
    model.mask_decoder.iou_prediction_head.proj_out.bias.data.fill_(0.9)
    model.save_pretrained(folder)
    pad = {"height": SIDE, "width": SIDE}
    SamImageProcessorPil(size={"longest_edge": SIDE}, pad_size=pad).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def sam(sam_folder):
    """The segmenter, with lower thresholds, because random weights give low scores."""
    limits = {"min_score": 0.8, "min_stability": 0.6, "max_box_overlap": 0.9, "max_fraction": 1.0}
    points = {"points_per_side": 6, "points_per_batch": 10}
    return dataclasses.replace(load_sam(sam_folder), **limits, **points, min_pixels=1)


@needs_foundation
def test_everything_agrees_with_sam_on_a_grid_of_points(sam, sam_folder):
    import torch
    from transformers import SamImageProcessorPil, SamModel

    assert isinstance(sam, Segmenter)
    found = sam.find(IMAGE)

    model = SamModel.from_pretrained(sam_folder).eval()
    pictures = SamImageProcessorPil.from_pretrained(sam_folder)
    _, points, crops, on_it = pictures.generate_crop_boxes(Image.fromarray(IMAGE), SIDE, points_per_crop=6)
    inputs = pictures(crops, return_tensors="pt")
    with torch.no_grad():
        outputs = model(pixel_values=inputs["pixel_values"], input_points=points, input_labels=on_it)
    logits = pictures.post_process_masks(
        outputs.pred_masks, inputs["original_sizes"], inputs["reshaped_input_sizes"], binarize=False
    )[0].flatten(0, 1)
    scores = outputs.iou_scores.flatten()
    stability = (logits > 1).sum((1, 2)) / (logits > -1).sum((1, 2))
    sure = (scores > 0.8) & (stability > 0.6)
    masks, scores = (logits > 0)[sure].numpy(), scores[sure].numpy()
    assert 10 < sure.sum() < len(sure)
    corners = [
        (mask.any(0).argmax(), mask.any(1).argmax(), WIDTH - 1 - mask.any(0)[::-1].argmax(),
         HEIGHT - 1 - mask.any(1)[::-1].argmax()) for mask in masks
    ]  # fmt: skip
    kept = greedy_suppression(np.array(corners, float), scores, 0.9)
    assert 1 < len(kept) < len(scores)
    np.testing.assert_allclose(found.scores, scores[kept], atol=1e-5)
    np.testing.assert_array_equal(found.boxes, np.array(corners)[kept])
    np.testing.assert_array_equal(found.masks, masks[kept])


@needs_torchvision
def test_everything_agrees_with_the_pipeline_of_transformers(sam, sam_folder):
    from transformers import SamImageProcessorPil, SamModel, pipeline

    model, pictures = (kind.from_pretrained(sam_folder) for kind in (SamModel, SamImageProcessorPil))
    limits = {"pred_iou_thresh": 0.8, "stability_score_thresh": 0.6, "crops_nms_thresh": 0.9}
    wanted = pipeline("mask-generation", model=model.eval(), image_processor=pictures, device="cpu")(
        Image.fromarray(IMAGE), points_per_crop=6, **limits
    )
    found = sam.find(IMAGE)
    assert len(wanted["masks"]) > 1
    np.testing.assert_allclose(found.scores, wanted["scores"], atol=1e-5)
    np.testing.assert_array_equal(found.masks, np.stack(wanted["masks"]))


@needs_foundation
def test_labels_are_named_by_size_and_a_difference_is_a_picture_as_any(sam):
    found = sam.find(IMAGE)
    labels = sam(IMAGE)
    np.testing.assert_array_equal(labels > 0, found.masks.any(0))
    sizes = np.bincount(labels.ravel())[1:]
    assert len(sizes) > 1
    assert (np.diff(sizes) <= 0).all()
    difference = np.abs(IMAGE / 255.0 - IMAGE[::-1] / 255.0)
    np.testing.assert_array_equal(sam(difference), sam(np.round(255 * difference).astype(np.uint8)))


@needs_foundation
def test_without_confident_masks_there_are_no_labels(sam):
    assert not dataclasses.replace(sam, min_score=1e9)(IMAGE).any()
    assert dataclasses.replace(sam, min_score=1e9).find(IMAGE).masks.shape == (0, HEIGHT, WIDTH)


@needs_foundation
def test_each_label_of_clicks_has_the_mask_that_sam_gives_for_them(sam, sam_folder):
    import torch
    from transformers import SamImageProcessorPil, SamModel, SamProcessor

    model = SamModel.from_pretrained(sam_folder).eval()
    processor = SamProcessor(SamImageProcessorPil.from_pretrained(sam_folder))

    def mask_of(points, on_it):
        inputs = processor(IMAGE, input_points=[points], input_labels=[on_it], return_tensors="pt")
        inputs["input_points"] = inputs["input_points"].float()
        sizes = inputs.pop("original_sizes"), inputs.pop("reshaped_input_sizes")
        with torch.no_grad():
            outputs = model(**inputs, multimask_output=len(points) == 1)
        best = int(outputs.iou_scores[0, 0].argmax())
        return processor.image_processor.post_process_masks(outputs.pred_masks, *sizes)[0][0, best].numpy()

    one = mask_of([[20, 30]], [1])
    assert 0 < one.mean() < 1
    labels = dataclasses.replace(sam, clicks=((20, 30, 5),))(IMAGE)
    np.testing.assert_array_equal(labels, np.where(one, 5, 0))

    clicks = ((20, 25, 9), (25, 12, 9), (28, 15, 2), (40, 20, 0))
    first = mask_of([[20, 25], [25, 12], [40, 20]], [1, 1, 0])
    second = mask_of([[28, 15], [40, 20]], [1, 0])
    assert (first & second).any()
    assert first.sum() > second.sum()
    labels = dataclasses.replace(sam, clicks=clicks)(IMAGE)
    np.testing.assert_array_equal(labels > 0, first | second)
    np.testing.assert_array_equal(labels[first & ~second], 9)
    np.testing.assert_array_equal(labels[second & ~first], 2)
    np.testing.assert_array_equal(labels[first & second], 2)


@pytest.mark.parametrize(
    ("clicks", "says"),
    [
        ([(52, 10, 1)], r"expected x in \[0, 52\) and y in \[0, 37\), found \(52, 10, 1\)"),
        ([(5, 5, 1), (5, -1, 2)], r"found \(5, -1, 2\)"),
        ([(5, 5, -3)], "labels of 0 or more"),
        ([(5, 5, 0)], "found only label 0"),
    ],
)
def test_clicks_on_nothing_are_refused(clicks, says):
    with pytest.raises(ValueError, match=says):
        SamSegmenter(None, None, None, clicks=tuple(clicks))(IMAGE)


def picture_settings():
    size = {"height": SIDE, "width": SIDE}
    done = {"do_resize": True, "do_rescale": True, "do_normalize": True, "rescale_factor": 1 / 255}
    return {**done, "size": size, "resample": 2, "image_mean": MEAN, "image_std": STD}


def save_sam2_settings(folder, one_file):
    """Saves them in the hub's layout, or in that of newer releases of transformers (`one_file`)."""
    picture = {**picture_settings(), "image_processor_type": "Sam2ImageProcessor"}
    video = {**picture_settings(), "video_processor_type": "Sam2VideoVideoProcessor"}
    whole = {"processor_class": "Sam2VideoProcessor", "point_pad_value": -10, "target_size": SIDE}
    if one_file:
        whole |= {"image_processor": picture, "video_processor": video}
    else:
        (folder / "preprocessor_config.json").write_text(json.dumps(picture))
        (folder / "video_preprocessor_config.json").write_text(json.dumps(video))
    (folder / "processor_config.json").write_text(json.dumps(whole))


@pytest.fixture(scope="module")
def sam2_folder(tmp_path_factory):
    import torch
    from transformers import Sam2VideoConfig, Sam2VideoMaskDecoderConfig, Sam2VideoModel

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam2")
    hidden = 128  # at least twice the 64 that are built in
    backbone = {"hidden_size": 8, "image_size": [SIDE, SIDE], "blocks_per_stage": [1, 1, 1, 1]}
    backbone |= {"embed_dim_per_stage": [8, 16, 32, 64], "num_attention_heads_per_stage": [1, 1, 2, 2]}
    backbone |= {"window_size_per_stage": [4, 4, 4, 4], "global_attention_blocks": []}
    vision = {"model_type": "sam2_vision_model", "fpn_hidden_size": hidden}
    vision |= {"backbone_config": {"model_type": "sam2_hiera_det_model", **backbone}}
    vision |= {
        "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[16] * 2, [8] * 2, [4] * 2],
    }
    config = Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": hidden, "image_size": SIDE, "mask_input_channels": 4},
        mask_decoder_config=Sam2VideoMaskDecoderConfig(
            hidden_size=hidden, mlp_dim=16, num_attention_heads=2, iou_head_hidden_dim=8
        ),
        image_size=SIDE,
        memory_attention_hidden_size=hidden,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=16,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=hidden,
        mask_downsampler_embed_dim=hidden,
        memory_fuser_embed_dim=hidden,
        memory_fuser_intermediate_dim=16,
        memory_fuser_num_layers=1,
    )
    model = Sam2VideoModel(config)
    for weights in model.mask_decoder.parameters():
        if weights.ndim > 1:
            torch.nn.init.normal_(weights, std=0.1)
    model.mask_decoder.pred_obj_score_head.proj_out.bias.data.fill_(100.0)  # every object is always visible
    model.save_pretrained(folder)
    save_sam2_settings(folder, one_file=False)
    return folder


@pytest.fixture(scope="module")
def views():
    """Three images larger than the model's input, and labels 3 and 7 of the first; 7 is a comb."""
    image = np.random.default_rng(1).integers(0, 256, (96, 130, 3), dtype=np.uint8)
    labels = np.zeros(image.shape[:2], np.int32)
    labels[12:50, 20:75] = 3
    labels[40:80, 60:110:3] = 7
    return np.stack([image, image[::-1], image[:, ::-1]]), labels


@needs_foundation
def test_sam2_agrees_with_transformers(sam2_folder, views):
    import torch
    from transformers import Sam2VideoInferenceSession, Sam2VideoModel, Sam2VideoProcessor

    images, labels = views
    propagate = load_sam2(sam2_folder)
    assert isinstance(propagate, Propagator)

    model = Sam2VideoModel.from_pretrained(sam2_folder).eval()
    small = [
        np.asarray(Image.fromarray(image).resize((SIDE, SIDE), Image.Resampling.BILINEAR)) for image in images
    ]
    pixels = (np.stack(small) / 255.0 - MEAN) / STD
    session = Sam2VideoInferenceSession(
        video=torch.tensor(pixels, dtype=torch.float32).permute(0, 3, 1, 2),
        video_height=96,
        video_width=130,
        dtype=torch.float32,
    )
    Sam2VideoProcessor.process_new_mask_for_video_frame(
        SimpleNamespace(target_size=SIDE), session, 0, [3, 7], [labels == 3, labels == 7]
    )
    upsample = torch.nn.Upsample((96, 130), mode="bilinear", align_corners=False)
    wanted = [upsample(model(session, frame_idx=view).pred_masks)[:, 0].numpy() for view in range(3)]
    assert np.std(wanted[1:]) > 0.01
    for found, logits in zip(propagate.logits(images, labels), wanted, strict=True):
        np.testing.assert_allclose(found, logits, atol=1e-5)

    found = propagate(images, labels)
    np.testing.assert_array_equal(found[0], labels)
    best = np.argmax(wanted, axis=1)[1:]
    np.testing.assert_array_equal(found[1:], np.where(np.max(wanted, 1)[1:] > 0, np.array([3, 7])[best], 0))
    assert np.unique(found[1:]).tolist() == [0, 3, 7]


@needs_torchvision
def test_sam2_agrees_with_the_complete_processor_of_transformers(sam2_folder, views):
    import torch
    from transformers import Sam2VideoModel, Sam2VideoProcessor

    # At the model's own size, because PIL and torchvision round differently when they resize.
    images, labels = views[0][:, :SIDE, 30 : 30 + SIDE], views[1][:SIDE, 30 : 30 + SIDE]
    processor = Sam2VideoProcessor.from_pretrained(sam2_folder)
    session = processor.init_video_session(video=list(images), dtype=torch.float32)
    processor.add_inputs_to_inference_session(
        session, frame_idx=0, obj_ids=[3, 7], input_masks=[labels == 3, labels == 7]
    )
    model = Sam2VideoModel.from_pretrained(sam2_folder).eval()
    outputs = model.propagate_in_video_iterator(session, start_frame_idx=0)
    for found, output in zip(load_sam2(sam2_folder).logits(images, labels), outputs, strict=True):
        wanted = processor.post_process_masks([output.pred_masks], [[SIDE, SIDE]], binarize=False)[0]
        np.testing.assert_allclose(found, wanted[:, 0], atol=1e-5)


@needs_foundation
@pytest.mark.parametrize("one_file", [False, True])
def test_the_settings_of_sam2_are_read_from_either_layout(sam2_folder, tmp_path, one_file):
    for name in ("config.json", "model.safetensors"):
        (tmp_path / name).symlink_to(sam2_folder / name)
    save_sam2_settings(tmp_path, one_file)
    pixels = load_sam2(tmp_path).processor([IMAGE * 0], return_tensors="pt")["pixel_values"]
    assert pixels.shape == (1, 3, SIDE, SIDE)
    np.testing.assert_allclose(pixels[0, :, 0, 0], -np.array(MEAN) / STD, rtol=1e-6)


@pytest.mark.thorough
def test_without_objects_sam2_is_not_asked_and_labels_of_another_size_are_refused(views):
    images, labels = views
    propagate = Sam2Propagator(None, None, None, None)
    assert not propagate(images, 0 * labels).any()
    with pytest.raises(
        ValueError, match=r"labels: expected shape \(96, 130\) to match images, found \(95, 130\)"
    ):
        propagate(images, labels[1:])
