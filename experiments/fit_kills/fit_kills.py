"""Kill -9 at random moments, resume, and compare with a run that was left alone."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

STEPS, SAVE_EVERY_S = 12_000, 1.0
SHORTEST_S, LONGEST_S = 2.0, 16.0  # lives, importing and compiling included


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Lives of random length, until as many were ended as asked; the last one may finish."""
    alone, killed = folder / "alone", folder / "killed"
    subprocess.run(_command(options, alone, seed, resume=False), check=True, capture_output=True)
    random, sound, before_any, lost = np.random.default_rng(seed), 0, 0, [0.0]
    begun_anew = True
    for _ in range(options["kills"]):
        process = subprocess.Popen(
            _command(options, killed, seed, resume=not begun_anew),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        time.sleep(random.uniform(SHORTEST_S, LONGEST_S))
        if process.poll() is not None:
            raise RuntimeError(f"a life ended by itself with {process.returncode}: {process.stdout.read()}")
        process.send_signal(signal.SIGKILL)
        at = time.time()
        process.wait()
        begun_anew = not (killed / "config.yml").exists()
        saved = sorted((killed / "resume").glob("step-*.npz")) if not begun_anew else []
        before_any += not saved
        if saved and _fits_since(killed, saved[-1]):
            lost.append(at - saved[-1].stat().st_mtime)
        sound += 1
    subprocess.run(_command(options, killed, seed, resume=True), check=True, capture_output=True)
    found = json.loads((killed / "metrics.json").read_text())
    return {
        "sound": sound,
        "before_any": before_any,
        "most_lost_s": max(lost),
        "equal": (alone / "scene.ply").read_bytes() == (killed / "scene.ply").read_bytes(),
        "steps": found["steps"],
    }


def _fits_since(run_folder: Path, checkpoint: Path) -> bool:
    """Whether the checkpoint was written in this life: else it had not begun to fit."""
    return checkpoint.stat().st_mtime > (run_folder / "config.yml").stat().st_mtime


def _command(options: dict[str, Any], out: Path, seed: int, resume: bool) -> list[str]:
    words = [sys.executable, "-m", "gsjax.cli", "fit", "simulated:tabletop?width=96&height=72&frames=3"]
    words += ["--out", str(out), "--fit.steps", str(STEPS), "--fit.cap", "800", "--fit.start.count", "500"]
    words += ["--fit.strategy", options["strategy"], "--fit.seed", str(seed), "--judge-every", "4000"]
    words += ["--save-every", str(SAVE_EVERY_S)]
    return words + (["--resume"] if resume else [])
