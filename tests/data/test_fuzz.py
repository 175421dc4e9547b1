"""Damaged files of every reader are read or refused in a sentence, in bounds; benchmarks/fuzz_files.py tries
more of them."""

import pytest

from benchmarks.fuzz_files import try_reader
from benchmarks.readers import READERS

CASES = 100  # of a reader; of slow ones, a share
SEED = 7


@pytest.mark.parametrize("name", READERS)
def test_what_is_damaged_is_read_or_refused_in_a_sentence(name, tmp_path):
    cases = [*try_reader(name, range(round(CASES * READERS[name].share)), SEED, tmp_path)]
    assert not [case for case in cases if case.outcome == "fault"]
    assert "refused" in {case.outcome for case in cases}
