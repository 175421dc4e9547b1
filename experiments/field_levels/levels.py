"""Things, their parts and what lies between, asked of a field on one level and of one on three."""

from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from experiments.shared.fields import articulated, labels_of, true_labels
from gsjax.data.simulated.flawed_masks import flawed_masks
from gsjax.engine.distill.scene import FieldScene
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.verbs import distill
from gsjax.methods.distill import PRESETS
from gsjax.perception.codebook import ClassCodebook
from gsjax.perception.levels import LEVELS

BACKGROUND = "background"
BASES = dict(enumerate(("drawer_base", "laptop_base", "faucet_base", "cabinet_base"), 7))  # in its meta.json
THINGS = {
    "drawers": ("drawer", "drawer_base"),
    "laptop": ("laptop_lid", "laptop_base"),
    "faucet": ("faucet_handle", "faucet_base"),
    "cabinet": ("door_left", "door_right", "cabinet_base"),
}
PAIRS = {"doors": ("door_left", "door_right")}  # a part of a thing that has parts
OF_WHOLE, OF_PARTS = 0.5, 0.3  # a crop of a part shows some of its thing, and one of a thing all its parts


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One field of masks with a segmenter's flaws, asked for each part, pair and thing by name."""
    scene = articulated(folder)
    files = folder / "features"
    names = write_features(scene, files, seed)
    teacher = TeacherChoice(str(files), level=options["level"])
    photographs = scene.photographs.select(scene.taught)
    begun = perf_counter()
    *_, last = distill(scene.gaussians, photographs, teacher, PRESETS[options["preset"]])
    seconds, result = perf_counter() - begun, last.result
    truth, label_of = true_labels(scene.gaussians, scene.photographs), {name: k for k, name in names.items()}
    book = ClassCodebook(dict(enumerate(words_of(names), 1)))
    ious: dict[str, list[float]] = {level: [] for level in LEVELS}
    right, found, times = [], [], []
    for level, (word, parts) in asked_of(names):
        vectors = np.stack([book.embed_text(one) for one in (word, *book.others(word))])
        jax.block_until_ready(result.scores(vectors))
        begun = perf_counter()
        scores = np.asarray(result.scores(vectors))
        times.append(perf_counter() - begun)
        ious[level].append(iou(scores > 0.5, np.isin(truth, [label_of[part] for part in parts]), truth >= 0))
        if result.levels:
            right.append(result.best_level(vectors) in levels_of(level, word))
        on = f" on {result.best_level(vectors)}" if result.levels else ""
        found.append(f"{word}{on}: {ious[level][-1]:.2f}")
    return {
        **{f"{level}_iou": float(np.mean(values)) for level, values in ious.items()},
        "mean_iou": float(np.mean([value for values in ious.values() for value in values])),
        "right_levels": 100 * float(np.mean(right)) if right else None,
        "taken_seconds": seconds,
        "query_ms": 1e3 * float(np.median(times)),
        "found": found,
    }


def asked_of(names: dict[int, str]) -> list[tuple[str, tuple[str, tuple[str, ...]]]]:
    """The level of each question, its word, and the true parts that it means."""
    parts = [("small", (name, (name,))) for name in names.values() if name in sum(THINGS.values(), ())]
    return [
        *parts,
        *(("medium", pair) for pair in PAIRS.items()),
        *(("large", one) for one in THINGS.items()),
    ]


def levels_of(level: str, word: str) -> tuple[str, ...]:
    """The levels on which a word is found: a thing without a pair has no mask on the middle one, which then
    is as the largest."""
    alone = level == "large" and not any(part in THINGS[word] for pair in PAIRS.values() for part in pair)
    return ("medium", "large") if alone else (level,)


def words_of(names: dict[int, str]) -> tuple[str, ...]:
    """All that can be asked for."""
    return (*names.values(), *PAIRS, *THINGS)


def write_features(scene: FieldScene, folder: Path, seed: int) -> dict[int, str]:
    """Feature files in LangSplat's layout for the photographs that teach: true masks with flaws on three
    levels, and class codes, mixed as crops mix what they show. Both stand in for SAM and CLIP. Returns the
    names of the true labels."""
    photographs = scene.photographs
    masks = [labels_of(photographs, i) for i in scene.taught]
    count = max(int(mask.max()) for mask in masks) + 1
    names = {0: BACKGROUND, **photographs.label_names, **BASES}
    assert sorted(names) == list(range(count))
    names = dict(sorted(names.items()))
    book = ClassCodebook(dict(enumerate(words_of(names), 1)))
    code = {word: np.asarray(book.embed_text(word)) for word in words_of(names)}
    wholes = {part: word for word, parts in (*THINGS.items(), *PAIRS.items()) for part in parts}  # pairs last
    wholes |= {pair: thing for pair, (part, *_) in PAIRS.items() for thing in THINGS if part in THINGS[thing]}

    def mixed(word: str) -> np.ndarray:
        whole = OF_WHOLE * mixed(wholes[word]) if word in wholes else 0.0
        parts = sum(
            (OF_PARTS * code[part] for part in (THINGS | PAIRS).get(word, ())), np.zeros_like(code[word])
        )
        vector = code[word] + whole + parts
        return vector / np.linalg.norm(vector)

    levels = [
        flawed(masks, [names[k] for k in range(count)], mixed, seed),
        flawed(*grouped(masks, names, PAIRS, alone=False), mixed, seed + 100),
        flawed(*grouped(masks, names, THINGS, alone=True), mixed, seed + 200),
    ]
    for v, i in enumerate(scene.taught):
        starts = np.cumsum([0, *(len(level.embeddings[v]) for level in levels)])
        ids = [
            np.where(one.labels[v] < 0, -1, one.labels[v] + at)
            for one, at in zip(levels, starts, strict=False)
        ]
        path = folder / photographs.names[i]
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path.with_name(f"{path.stem}_s.npy"), np.stack([ids[0], *ids]).astype(np.int32))
        table = np.concatenate([level.embeddings[v] for level in levels]).astype(np.float32)
        np.save(path.with_name(f"{path.stem}_f.npy"), table)
    return names


def grouped(
    masks: list[Int[np.ndarray, "..."]],
    names: dict[int, str],
    groups: dict[str, tuple[str, ...]],
    *,
    alone: bool,
) -> tuple[list[np.ndarray], list[str]]:
    """Masks of groups of parts, and their names; what is in no group is one `alone`, or background."""
    words = [BACKGROUND, *groups]
    of = {part: word for word, parts in groups.items() for part in parts}
    if alone:
        words += [name for k, name in names.items() if k and name not in of]
    place = np.array([words.index(of.get(name, name if alone else BACKGROUND)) for name in names.values()])
    return [place[mask] for mask in masks], words


def flawed(masks: list[np.ndarray], words: list[str], mixed: Any, seed: int) -> Any:
    """Masks with a segmenter's flaws; what is in none of them is unknown."""
    found = flawed_masks(masks, np.stack([mixed(word) for word in words]), seed)
    if len(words) - 1 == len(PAIRS):  # on the middle level most pixels have no mask
        found = found._replace(labels=[np.where(one == 0, -1, one) for one in found.labels])
    return found


def iou(found: np.ndarray, true: np.ndarray, known: np.ndarray) -> float:
    """Intersection over union of Gaussians whose label is known."""
    found, true = found & known, true & known
    return float((found & true).sum() / max(1, (found | true).sum()))


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A group of bars for each kind of question, a bar for each field."""
    from matplotlib.figure import Figure

    kinds = {"small_iou": "parts", "medium_iou": "both doors", "large_iou": "things"}
    variants = list(dict.fromkeys((row["preset"], row["level"]) for row in rows))
    drawing = Figure(figsize=(7, 3.6), dpi=110, layout="constrained")
    axes, wide = drawing.subplots(), 0.8 / len(variants)
    for number, (preset, level) in enumerate(variants):
        mine = [row for row in rows if (row["preset"], row["level"]) == (preset, level)]
        values = np.array([[row[key] for key in kinds] for row in mine])
        means = values.mean(axis=0)
        spread = np.stack([means - values.min(axis=0), values.max(axis=0) - means])
        label = f"{preset}, " + ("three levels" if level == "each" else f"level {level} alone")
        places = np.arange(len(kinds)) + (number - (len(variants) - 1) / 2) * wide
        axes.bar(places, means, 0.92 * wide, yerr=np.maximum(spread, 0), capsize=2, label=label)
    axes.set(xticks=range(len(kinds)), xticklabels=kinds.values(), ylim=(0, 1), ylabel="IoU of Gaussians")
    axes.grid(alpha=0.3, axis="y")
    axes.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
