"""Errors of images and all gradients against the float64 reference, over seeded scenes and all modes.

Run it with

    python -m benchmarks.exactness              # 52 scenes; writes benchmarks/results/exactness.json
    python -m benchmarks.exactness --scenes 5   # a quick check; writes nothing
"""

import argparse
import json
import time
from pathlib import Path

import jax

from benchmarks.scenes import case, compare
from gsjax.engine import machine

RESULT = Path(__file__).parent / "results" / "exactness.json"
SCENES = 52
LIMITS = {"float64": (1e-6, 1e-6), "float32": (1e-5, 1e-4)}  # images, gradients
DOUBTFUL_LIMIT = 1e-3


def _worst(errors: dict[str, float], images: bool) -> tuple[float, str]:
    return max((v, k) for k, v in errors.items() if k.endswith("image") == images)


def summary(scenes: list[dict]) -> dict:
    """Worst error of each array over all scenes, and the fraction of doubtful pixels, which are left out."""
    worst = {
        dtype: {
            name: max(s[dtype][name] for s in scenes if name in s[dtype])
            for name in sorted({name for s in scenes for name in s[dtype]})
        }
        for dtype in LIMITS
    }
    pixels = sum(s["width"] * s["height"] for s in scenes)
    doubtful = sum(s["doubtful_share"] * s["width"] * s["height"] for s in scenes) / pixels
    within = [
        _worst(worst[dtype], images=images)[0] <= limit
        for dtype, limits in LIMITS.items()
        for images, limit in zip((True, False), limits, strict=True)
    ]
    return {
        "scenes": len(scenes),
        "pixels": pixels,
        "doubtful_share": doubtful,
        "worst_doubtful_share": max(s["doubtful_share"] for s in scenes),
        "shortest_longest_list": min(s["longest_list"] for s in scenes),
        "worst": worst,
        "limits": {k: {"images": i, "gradients": g} for k, (i, g) in LIMITS.items()},
        "passed": all(s["doubtful_share"] < DOUBTFUL_LIMIT for s in scenes) and all(within),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=SCENES)
    count = parser.parse_args().scenes
    print(machine.in_words(machine.describe()))
    print("worst relative error of images | of gradients, in float64 and float32")
    began, scenes = time.perf_counter(), []
    with jax.enable_x64(True):
        for seed in range(count):
            this = case(seed)
            found = compare(this)
            size = {"num": this.num, "width": this.width, "height": this.height}
            scenes.append({"seed": seed, **size, "mode": this.mode, **found})
            figures = []
            for dtype in LIMITS:
                (image, _), (gradient, name) = _worst(found[dtype], True), _worst(found[dtype], False)
                figures.append(f"{image:.1e} | {gradient:.1e} ({name})")
            print(
                f"{seed:3} N={this.num:4} {this.width}x{this.height} "
                f"longest list {found['longest_list']:4} doubtful {found['doubtful_share']:.3%}  "
                f"{figures[0]:27} {figures[1]:27} {this.mode}",
                flush=True,
            )
            jax.clear_caches()  # every scene compiles its own programs, so caching them is useless
    bottom = summary(scenes)
    seconds = time.perf_counter() - began
    print(json.dumps(bottom, indent=2), f"\n{seconds:.0f} s")
    if count == SCENES:
        record = {"machine": machine.describe(), "seconds": round(seconds), "summary": bottom}
        record["scenes"] = scenes
        RESULT.parent.mkdir(exist_ok=True)
        RESULT.write_text(json.dumps(record, indent=1) + "\n")
    if not bottom["passed"]:
        raise SystemExit("an error exceeds its limit")


if __name__ == "__main__":
    main()
