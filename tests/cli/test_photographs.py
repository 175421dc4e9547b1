"""Which photographs are fitted, and which are held out."""

from dataclasses import replace

import numpy as np
import pytest

from gsjax.engine.files import read_options
from gsjax.engine.photographs import choose_photographs, photographs_of_run, split

RECORDING = "simulated:tabletop?width=32&height=24&frames=4"  # cameras 0, 1 and 2
NINE = "simulated:tabletop?width=32&height=24&frames=3"


@pytest.mark.thorough
def test_frames_and_cameras_of_a_recording():
    every = choose_photographs(RECORDING)
    assert every.num == 12
    assert every.splits is None
    one = choose_photographs(RECORDING, frames="2:3", eval_cameras=(1,))
    assert one.names == ("0/2", "2/2", "1/2")
    assert one.splits == ("train", "train", "test")
    np.testing.assert_array_equal(one.image(2), every.image(every.names.index("1/2")))
    assert choose_photographs(RECORDING, cameras=(2, 0), frames="::2").names == ("2/0", "0/0", "2/2", "0/2")
    small = choose_photographs(RECORDING, scale=0.5, frames=":1")
    assert small.sizes.tolist() == [[16, 12]] * 3


@pytest.mark.filterwarnings("ignore:.*with no file")
def test_some_of_photographs(photographs):
    assert choose_photographs(str(photographs)).num == 9
    assert choose_photographs(str(photographs), frames="1:8:2").names == tuple(
        choose_photographs(str(photographs)).names[i] for i in (1, 3, 5, 7)
    )
    with pytest.raises(ValueError, match=r"--cameras: .* holds photographs, not a recording"):
        choose_photographs(str(photographs), cameras=(0,))
    with pytest.raises(ValueError, match=r"--frames: 9: selects no photograph of .* 0 to 8"):
        choose_photographs(str(photographs), frames="9:")


@pytest.mark.thorough
def test_those_of_a_run_are_found_by_its_settings():
    settings = {"dataset": RECORDING, "scale": 0.5, "read": {"K": None}, "frames": "1:2", "cameras": [2]}
    found = photographs_of_run(settings)
    assert found.names == ("2/1",)
    assert found.sizes.tolist() == [[16, 12]]
    assert photographs_of_run({"dataset": "gone"}, dataset=RECORDING).num == 12
    older = {"dataset": RECORDING, "read": {"near": 0.5, "no_longer_there": 3}}
    assert photographs_of_run(older).near == 0.5
    assert read_options({"K": [1.0, 1.0, 1.0, 1.0]}).K == (1.0, 1.0, 1.0, 1.0)  # YAML has no tuples
    with pytest.raises(KeyError):
        photographs_of_run({"scale": 1.0})


@pytest.mark.thorough
def test_what_is_held_out_is_as_the_data_says_or_every_so_manieth():
    nine = choose_photographs(NINE)
    chosen, held_out = split(nine, 4)
    assert held_out.tolist() == [0, 4, 8]
    assert sorted([*chosen, *held_out]) == list(range(9))
    assert split(nine, 0)[1].tolist() == []
    alone = nine.select([3])
    assert [part.tolist() for part in split(alone, 8)] == [[0], []]
    said = replace(nine, splits=("train",) * 6 + ("val",) + ("test",) * 2)
    assert [part.tolist() for part in split(said, 4)] == [[0, 1, 2, 3, 4, 5], [7, 8]]
    with pytest.raises(ValueError, match="expected photographs to fit, found all"):
        split(replace(nine, splits=("test",) * 9), 4)
