"""How often are ten types of question about a deforming scene answered correctly?"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.shared.deform_regions import with_errors
from experiments.shared.deform_truth import NAMES, Truth, built_in
from experiments.shared.deforming import Dataset, Reconstructed, dataset, learned, summary
from gsjax.engine.deform.data import unit_times
from gsjax.geometry.cameras import NEAR
from gsjax.methods.deform import (
    PRESETS,
    QUESTIONS,
    DeformResult,
    GraphConfig,
    Lesson,
    Meaning,
    Question,
    SceneFacts,
    TemplatedAnswerer,
    Timeline,
    parse_question,
    scene_facts,
)

CONFIG = replace(
    PRESETS["surst"],
    warmup=100,
    iterations=300,
    start_pixels=2.2,
    channels=8,
    graph=GraphConfig(kind="none"),
)
WRONG = {"labels all right": 0.0, "labels 30 % wrong": 0.3}
ASKED = 120  # questions of each type except when
FIRST = 0.25  # of the recording: the frame that the canonical scene is like, with the tool in view
WITHIN = {"depth": 1.0, "distance": 2.0, "motion": 0.5, "when": 2}  # mm, and frames
EVENTS = ("first seen", "fastest", "nearest", "touch")


class Asked(NamedTuple):
    """A question, and its true answer."""

    text: str
    meant: Question
    true: Any


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Questions about five regions of the tissue and the tool, answered from a scene, or by the best constant
    answer to each type."""
    data, truth = _data(options["scene"], seed)
    asked = questions(truth)
    if options["answers"] == "blind":
        return _blind(asked)
    found = _learned(data, truth, WRONG[options["answers"]], seed)
    facts = _facts(data, found)
    answer = TemplatedAnswerer()
    right = [_right(one.meant.kind, answer(one.text, facts).value, one.true) for one in asked]
    tool = [NAMES.index("tool") in one.meant.things for one in asked]
    shares, of_tool, of_tissue = {}, {}, {}
    for kind in QUESTIONS:
        of_kind = [one.meant.kind == kind.name for one in asked]
        shares[kind.name] = _share(right, of_kind)
        of_tool[f"{kind.name}_tool"] = _share(right, [a and b for a, b in zip(of_kind, tool, strict=True)])
        of_tissue[f"{kind.name}_tissue"] = _share(right, [a > b for a, b in zip(of_kind, tool, strict=True)])
    out = [bool(one.meant.frames) and set(one.meant.frames) <= set(truth.data.test) for one in asked]
    return {
        **shares,
        "all": float(np.mean(list(shares.values()))),
        "held_out": _share(right, out),
        "all_tissue": float(np.mean(list(of_tissue.values()))),
        "all_tool": float(np.mean(list(of_tool.values()))),
        **of_tissue,
        **of_tool,
        "questions": len(asked),
        **summary(found),
    }


def _data(scene: str, seed: int) -> tuple[Dataset, Truth]:
    """Training data and truth; of tissue_0 the training pictures have half of its width and height."""
    if scene == "tissue_0":
        return dataset(scale=0.5), Truth(dataset())
    data = built_in(seed)
    return data, Truth(data)


def questions(truth: Truth) -> list[Asked]:
    """The questions, the same for all answerers."""
    rng, things, texts = np.random.default_rng(0), NAMES[1:], []
    for kind in QUESTIONS:
        if kind.name == "when":
            texts += [f"when is {one} {event}?" for one in things for event in EVENTS[:-1]]
            texts += [f"when do {one} and tool first touch?" for one in things[:-1]]
            continue
        for _ in range(ASKED):
            one, other = rng.choice(things, 2, replace=False)
            f, g = rng.choice(truth.count, 2, replace=False)
            given = {"X": one, "Y": other, "F": str(f), "G": str(g)}
            texts.append(" ".join(given.get(word.rstrip("?,"), word) for word in kind.example.split()))
    meant = [parse_question(text, NAMES) for text in texts]
    return [Asked(text, q, truth.answer(q)) for text, q in zip(texts, meant, strict=True)]


def _learned(data: Dataset, truth: Truth, wrong: float, seed: int) -> Reconstructed:
    """The scene with its tool, learned from all training frames with a teacher that errs."""
    rng, config = np.random.default_rng(seed), replace(CONFIG, seed=seed)
    codes, step = np.eye(len(NAMES), config.channels), truth.data.sequence.width // data.sequence.width
    labels = truth.labels[:, step // 2 :: step, step // 2 :: step]
    ids = [with_errors(labels[t], wrong, rng, classes=len(NAMES)) for t in data.train]
    frames = [data.frame(t, tools=True) for t in data.train]
    return learned(frames, config, Lesson(ids, codes), first=round(FIRST * len(frames)))


def _facts(data: Dataset, found: Reconstructed) -> SceneFacts:
    """Facts of all frames."""
    seen, codes = data.sequence, np.eye(len(NAMES), found.config.channels)
    frames, size = np.arange(seen.num_frames), (seen.width, seen.height)
    cameras = (seen.viewmats[:, 0], seen.Ks[:, 0], size, NEAR)
    timeline = Timeline(unit_times(seen), frames, 1.0, *cameras, np.zeros(0, int))
    meaning = Meaning(None, tuple(NAMES), codes, np.eye(found.config.channels))
    result = DeformResult(found.run.params, found.run.kept.moving, meaning, timeline)
    return scene_facts(result, range(seen.num_frames))


def _right(kind: str, answer: Any, true: Any) -> bool:
    """Whether an answer is right: a number within the tolerance of its type, anything else exactly."""
    if kind not in WITHIN or answer is None or true is None:
        return answer == true
    return abs(answer - true) <= WITHIN[kind]


def _blind(asked: list[Asked]) -> dict[str, float]:
    """Shares of right answers of the best constant answer to each type."""
    shares = {}
    for kind in QUESTIONS:
        true = [one.true for one in asked if one.meant.kind == kind.name]
        shares[kind.name] = max(
            100 * float(np.mean([_right(kind.name, guess, value) for value in true])) for guess in true
        )
    return {**shares, "all": float(np.mean(list(shares.values()))), "questions": len(asked)}


def _share(right: list[bool], which: list[bool]) -> float:
    """Percentage of right answers among the chosen ones."""
    return 100 * float(np.mean(np.array(right)[which]))
