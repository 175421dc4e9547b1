"""What a fit of given minutes can afford."""

from itertools import pairwise

import pytest

from gsjax.engine.fit.costs import final_shrink, settings_within, step_seconds
from gsjax.methods.fit import FitConfig

MINUTES = (0.2, 1, 2, 5, 15, 60, 600, 10_000)


@pytest.mark.parametrize("size", [(270, 480), (1600, 900)])
def test_more_minutes_buy_more_gaussians_of_higher_degrees(size):
    found = [settings_within(FitConfig(), size, minutes) for minutes in MINUTES]
    for (config, steps), (more, later) in pairwise(found):
        assert config.cap <= more.cap
        assert config.sh_degree <= more.sh_degree
        assert steps < later or more.cap > config.cap
    assert [config.sh_degree for config, _ in found][:: len(MINUTES) - 1] == [0, 3]
    assert 5_000 <= found[0][0].cap < found[-1][0].cap <= 1_000_000


@pytest.mark.parametrize("minutes", MINUTES)
def test_slots_follow_from_steps_and_a_degree_is_unlocked_in_the_first_half(minutes):
    config, steps = settings_within(FitConfig(), (270, 480), minutes)
    assert config.cap == 5_000 or config.cap <= 20 * steps
    assert config.start.count <= min(config.cap, FitConfig().start.count)
    assert config.sh_degree * config.sh_every <= steps / 2


def test_the_last_size_leaves_time_for_its_steps():
    config, size = FitConfig(), (1600, 900)
    for seconds in (10.0, 100.0, 1000.0, 1e5):
        factor = final_shrink(config, size, seconds)
        pixels = size[0] * size[1] / factor**2
        fits = 150 * step_seconds(pixels, config.start.count) <= seconds / 5
        assert fits or 900 / factor < 8 * 32
    assert final_shrink(config, size, 1e5) == 1
