"""Every reader reads a damaged file or refuses it with a short message, within limits of time and memory;
benchmarks/fuzz_files.py tries more files."""

import numpy as np
import pytest

from benchmarks.fuzz_files import try_reader
from benchmarks.mutations import mutated
from benchmarks.readers import READERS

CASES = 100  # per reader; slow readers get a share of them
SEED = 7


@pytest.mark.thorough
@pytest.mark.parametrize("name", READERS)
def test_what_is_damaged_is_read_or_refused_in_a_sentence(name, tmp_path):
    if needs := READERS[name].needs:
        pytest.importorskip(needs)
    cases = [*try_reader(name, range(round(CASES * READERS[name].share)), SEED, tmp_path)]
    assert not [case for case in cases if case.outcome == "fault"]
    assert "refused" in {case.outcome for case in cases}


@pytest.mark.thorough
def test_a_case_is_made_from_its_number_alone():
    content = b'{"a": {"b": [1, 2]}, "c": 3}'
    numbers = range(3000)
    first = [mutated(content, [content], np.random.default_rng([SEED, n])) for n in numbers]
    again = [mutated(content, [content], np.random.default_rng([SEED, n])) for n in numbers]
    assert first == again
