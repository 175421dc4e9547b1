"""Which values of a label map are tools."""

import pytest

from gsjax.data.endovis import INSTRUMENTS, PARTS
from gsjax.data.tool_masks import is_tool

# From EndoVis 2018's labels.json.
SCENE = {
    0: "background-tissue",
    1: "instrument-shaft",
    2: "instrument-clasper",
    4: "kidney-parenchyma",
    5: "covered-kidney",
    6: "thread",
    8: "suturing-needle",
    9: "suction-instrument",
    10: "small-intestine",
    11: "ultrasound-probe",
}


def test_by_their_names():
    tools = {value for value in SCENE if is_tool(value, SCENE)}
    assert tools == {1, 2, 6, 8, 9, 11}
    assert all(is_tool(value, INSTRUMENTS) for value in INSTRUMENTS)
    assert all(is_tool(value, PARTS) for value in PARTS)
    assert is_tool(1, {1: "tool"})


@pytest.mark.parametrize(("value", "tool"), [(-1, False), (0, False), (1, True), (7, True)])
def test_without_a_name_any_value_above_0_is_a_tool(value, tool):
    assert is_tool(value, {}) is tool
