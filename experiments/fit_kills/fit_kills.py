"""Kill -9 at random moments, resume, and compare with a run that was left alone."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

STEPS, SAVE_EVERY_S, LOGGED_EVERY = 12_000, 1.0, 100
SHORTEST_S, LONGEST_S = 2.0, 16.0  # lives, importing and compiling included


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Lives of random length, until as many were ended as asked; then one that may finish.

    A resume is sound when the next life leaves no older state behind than the one before it; in the end, the
    scene and all losses on the way are those of the run that was left alone.
    """
    alone, killed = folder / "alone", folder / "killed"
    subprocess.run(_command(options, alone, seed, resume=False), check=True, capture_output=True)
    random, ends, lost_steps = np.random.default_rng(seed), [], []
    for _ in range(options["kills"]):
        resume = (killed / "config.yml").exists()
        process = subprocess.Popen(
            _command(options, killed, seed, resume),
            stdout=subprocess.DEVNULL,
            stderr=(folder / "said.txt").open("w"),
        )
        time.sleep(random.uniform(SHORTEST_S, LONGEST_S))
        if process.poll() is not None:
            raise RuntimeError(f"a life ended by itself: {(folder / 'said.txt').read_text()}")
        process.send_signal(signal.SIGKILL)
        process.wait()
        ends.append((_saved(killed), _logged(killed)))
        lost_steps.append(max(0, ends[-1][1] - ends[-1][0]))
    subprocess.run(_command(options, killed, seed, resume=True), check=True, capture_output=True)
    lines = [(place / "metrics.jsonl").read_text().splitlines() for place in (alone, killed)]
    curves = [[(row["step"], row["loss"], row["alive"]) for row in map(json.loads, rows)] for rows in lines]
    saved = [end[0] for end in ends]
    return {
        "sound": sum(b >= a for a, b in zip([0, *saved], [*saved, STEPS], strict=False)),
        "before_any": sum(step == 0 for step in saved),
        "saved_at": saved,
        "most_lost": max(lost_steps),
        "same_scene": (alone / "scene.ply").read_bytes() == (killed / "scene.ply").read_bytes(),
        "same_curve": curves[0] == curves[1],
        "steps": json.loads((killed / "metrics.json").read_text())["steps"],
    }


def _saved(run_folder: Path) -> int:
    """The step of the newest checkpoint."""
    return max(
        (int(path.stem.split("-")[1]) for path in (run_folder / "resume").glob("step-*.npz")), default=0
    )


def _logged(run_folder: Path) -> int:
    """The last step that stands in metrics.jsonl."""
    path = run_folder / "metrics.jsonl"
    return json.loads(path.read_text().splitlines()[-1])["step"] if path.exists() else 0


def _command(options: dict[str, Any], out: Path, seed: int, resume: bool) -> list[str]:
    words = [sys.executable, "-m", "gsjax.cli", "fit", "simulated:tabletop?width=96&height=72&frames=3"]
    words += ["--out", str(out), "--fit.steps", str(STEPS), "--fit.cap", "800", "--fit.start.count", "500"]
    words += ["--fit.strategy", options["strategy"], "--fit.seed", str(seed), "--judge-every", "4000"]
    words += ["--fit.exposure", "--fit.refine-poses", "--save-every", str(SAVE_EVERY_S)]
    return words + (["--resume"] if resume else [])
