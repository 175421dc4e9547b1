"""Records demonstrations into runs/policies: `MUJOCO_GL=egl python -m experiments.policies.demonstrations`.

Only successful ones are kept. Each file holds the observations of all policies, so that all learn from the
same data: images, the can's true poses, its tracked poses, proprioception and actions.
"""

import sys
from pathlib import Path

import numpy as np

from experiments.policies.bins import HORIZON, NOISE, STEP, Bins, Script
from experiments.policies.sight import Tracking, small
from gsjax.io.atomic import write_json

HOME = Path(__file__).resolve().parents[2] / "runs" / "policies"
FIRST = 10_000  # seeds of demonstrations; rollouts begin at 0
AFTER = 6  # periods recorded after success


def demonstrate(world: Bins, seed: int, look: bool = True) -> dict[str, np.ndarray] | None:
    """One demonstration, or None if it fails; without `look` it holds no observations."""
    world.begin(seed)
    rng, script, tracking = np.random.default_rng(seed), Script(world), Tracking(world)
    steps, done = [], 0
    for _ in range(HORIZON):
        felt, can, action = world.feel().vector(), world.can(), script()
        if look:
            colors, depths = world.cameras.images(world.data)
            seen = {"tracked": tracking.see(colors, depths), "true": can, "images": small(colors)}
            steps.append({**seen, "felt": felt, "action": action})
        noise = np.append(rng.normal(size=3) * NOISE / STEP, 0.0)
        world.move(action + noise * (script.phase in (0, 3, 4)))
        done += world.success()
        if done > AFTER:
            return {name: np.stack([step[name] for step in steps]) for name in (steps[0] if look else ())}
    return None


def record(count: int) -> None:
    """Record demonstrations until `count` have succeeded; those on disk count."""
    HOME.mkdir(parents=True, exist_ok=True)
    world, good, tried = Bins(), 0, 0
    while good < count:
        path = HOME / f"demo_{tried:03d}.npz"
        seed, missing = FIRST + tried, not path.exists()
        if (
            missing
            and demonstrate(world, seed, look=False) is not None
            and (seen := demonstrate(world, seed))
        ):
            np.savez_compressed(path, **seen)
        good, tried = good + path.exists(), tried + 1
        write_json(HOME / "demonstrations.json", {"tried": tried, "kept": good})
    print(f"{good} of {tried} demonstrations succeeded")


if __name__ == "__main__":
    record(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
