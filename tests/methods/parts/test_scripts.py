"""Edit scripts: what is written is read, what is wrong is said, and what is saved is read again."""

from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.methods.parts.entries import key_of
from gsjax.methods.parts.operations import (
    OPERATIONS,
    Amplify,
    Composite,
    Echo,
    Fade,
    Freeze,
    Ghost,
    Isolate,
    Loop,
    Move,
    Place,
    Redirect,
    Rotate,
    Scale,
    Speed,
    describe_operation,
    example_line,
)
from gsjax.methods.parts.timeline import Script, parse_op, parse_script, to_yaml

EXAMPLE = """
fps: 8
length: 2
edits:
  - {op: speed, parts: [drawer], factor: 2}
  - {op: loop, parts: [2], from: 0.5, to: 1, times: 3}
  - {op: freeze, parts: lid, at: 1.0}
  - {op: echo, parts: [3], copies: 2, every: 0.25, fade: 0.5}
  - {op: rotate, parts: [drawer, 3], axis: [0, 0, 1], degrees: 30, from: 0, to: 2, ease: 0.5}
  - {op: composite, from_run: other, parts: [cup], place: {to: [1, 2, 3], degrees: 90, scale: 1e-1},
     edits: [{op: speed, parts: all, factor: -1}]}
"""


class TestScripts:
    def test_the_example_is_what_it_says(self):
        script = parse_script(EXAMPLE)
        assert (script.fps, script.length) == (8.0, 2.0)
        assert script.edits == (
            Speed(parts=("drawer",), factor=2.0),
            Loop(parts=(2,), begin=0.5, end=1.0, times=3),
            Freeze(parts=("lid",), at=1.0),
            Echo(parts=(3,), copies=2, every=0.25, fade=0.5),
            Rotate(parts=("drawer", 3), axis=(0.0, 0.0, 1.0), degrees=30.0, begin=0.0, end=2.0, ease=0.5),
            Composite(
                parts=("cup",),
                from_run="other",
                place=Place(to=(1.0, 2.0, 3.0), degrees=90.0, scale=0.1),
                edits=(Speed(parts=("all",), factor=-1.0),),
            ),
        )

    def test_nothing_is_a_script(self):
        assert parse_script("") == parse_script("edits: []") == Script()

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("edits: [", "expected YAML, found a fault in line 1"),
            ("- {op: speed}", "expected the keys fps, length, edits, found"),
            ("edit: []", "edit: expected one of fps, length, edits, found 'edit'; did you mean 'edits'?"),
            ("fps: fast", "fps: expected frames a second, 0.1 to 1000, found 'fast'"),
            ("length: 0", "length: expected seconds, 0.01 to 86400, found 0"),
            ("edits: 3", "edits: expected a list of edits, found 3"),
            ("edits: [speed]", "edits: edit 1: expected a mapping with the key op, found 'speed'"),
            ("edits: [{op: fade, parts: 1}, {op: sped}]", "edit 2: op: expected one of isolate, freeze, "),
            ("edits: [{op: sped, parts: 1}]", "found 'sped'; did you mean 'speed'?"),
            ("edits: [{op: remove, parts: 1}]", "found 'remove'; fade with opacity 0 takes parts away"),
            ("edits: [{op: [1], parts: 1}]", "edit 1: op: expected one of "),
            ("edits: [{op: speed, parts: 1}]", "edit 1 (speed): factor: expected a factor from 0.01 to 100"),
            ("edits: [{op: speed, parts: 1}]", ", found nothing"),
            (
                "edits: [{op: speed, factor: 2}]",
                "parts: expected names or numbers of parts, or all, found nothing",
            ),
            ("edits: [{op: speed, parts: 1, factor: 0}]", "factor: expected a factor from 0.01 to 100"),
            ("edits: [{op: speed, parts: 1, factor: yes}]", "factor: expected a factor from 0.01 to 100"),
            ("edits: [{op: speed, parts: 1, factr: 2}]", "found 'factr'; did you mean 'factor'?"),
            ("edits: [{op: fade, parts: []}]", "parts: expected names or numbers of parts, or all, found []"),
            ("edits: [{op: fade, parts: [1.5]}]", "parts: expected names or numbers of parts, or all, found"),
            ("edits: [{op: fade, parts: [yes]}]", "parts: expected names or numbers of parts, or all, found"),
            (f"fps: {'1' * 400}", "fps: expected frames a second, 0.1 to 1000, found 1111"),
            (
                f"edits: [{{op: move, parts: 1, by: [0, 0, {'9' * 400}]}}]",
                "by: expected metres as [x, y, z], found",
            ),
            (
                f"edits: [{{op: loop, parts: 1, times: {'9' * 400}}}]",
                "times: expected a whole number from 1 to 1000",
            ),
            (f"fps: {'1' * 5000}", "expected YAML, found a value that cannot be read"),
            ("length: 2026-02-30", "expected YAML, found a value that cannot be read: day is out of range"),
            ("edits: " + "[" * 5000 + "]" * 5000, "found lists or mappings nested too deeply to be read"),
            (
                "edits: [{op: fade, parts: 1, opacity: 2}]",
                "opacity: expected a factor on opacities, 0 to 1, found 2",
            ),
            ("edits: [{op: fade, parts: 1, from: 2, to: 1}]", "to: expected a time after from, 2, found 1"),
            (
                "edits: [{op: fade, parts: 1, from: -1}]",
                "from: expected seconds from the film's start, 0 or more",
            ),
            (
                "edits: [{op: fade, parts: 1, from: .nan}]",
                "from: expected seconds from the film's start, 0 or more",
            ),
            (
                "edits: [{op: loop, parts: 1, times: 1.5}]",
                "times: expected a whole number from 1 to 1000, found 1.5",
            ),
            ("edits: [{op: loop, parts: 1, bounce: 1}]", "bounce: expected true or false, found 1"),
            ("edits: [{op: move, parts: 1, by: [1, 2]}]", "by: expected metres as [x, y, z], found [1, 2]"),
            ("edits: [{op: move, parts: 1, by: abc}]", "by: expected metres as [x, y, z], found 'abc'"),
            (
                "edits: [{op: rotate, parts: 1, axis: [0, 0, 0], degrees: 3}]",
                "edit 1 (rotate): axis: expected a direction of the world as [x, y, z], found [0, 0, 0]",
            ),
            ("edits: [{op: echo, parts: 1, every: 0}]", "every: expected seconds other than 0, found 0"),
            (
                "edits: [{op: composite, parts: 1, from_run: ''}]",
                "from_run: expected the folder of a run, found ''",
            ),
            (
                "edits: [{op: composite, parts: 1, from_run: a, place: {too: 1}}]",
                "edit 1 (composite): place: too: expected one of to, axis, degrees, scale, found 'too'; "
                "did you mean 'to'?",
            ),
            (
                "edits: [{op: composite, parts: 1, from_run: a, edits: [{op: scale, parts: 1, factor: 0}]}]",
                "edit 1 (composite): edits: edit 1 (scale): factor: expected a factor from 0.001 to 1000",
            ),
        ],
    )
    def test_what_is_wrong_is_said_with_its_place(self, text, message):
        with pytest.raises(ValueError) as error:  # noqa: PT011
            parse_script(text)
        assert message in str(error.value)

    def test_edits_made_in_python_are_checked_too(self):
        with pytest.raises(ValueError, match=r"factor: expected a factor from 0\.01 to 100"):
            Speed(parts=(1,), factor=1000.0)
        with pytest.raises(ValueError, match="to: expected a time after from"):
            Fade(parts=(1,), begin=1.0, end=1.0)

    @pytest.mark.parametrize(
        ("line", "edit"),
        [
            ("speed:parts=drawer,factor=2", Speed(parts=("drawer",), factor=2)),
            ("freeze: parts=[1, lid], at=0.5", Freeze(parts=(1, "lid"), at=0.5)),
            (
                "rotate:parts=1,axis=[0, 0, 1],degrees=-3e1,from=1",
                Rotate(parts=(1,), axis=(0, 0, 1), degrees=-30, begin=1),
            ),
            (
                "composite:parts=all,from_run=runs/a=b,place={to: [1, 2, 3]}",
                Composite(parts=("all",), from_run="runs/a=b", place=Place(to=(1, 2, 3))),
            ),
        ],
    )
    def test_one_line_is_one_edit(self, line, edit):
        assert parse_op(line) == edit

    @pytest.mark.parametrize(
        ("line", "message"),
        [
            ("sped:parts=1", "did you mean 'speed'?"),
            ("speed", "parts: expected names or numbers of parts, or all, found nothing"),
            ("speed:parts=1,factor=[", "expected YAML, found"),
            (f"speed:parts=1,factor={'1' * 400}", "factor: expected a factor from 0.01 to 100"),
            ("speed:parts=" + "[" * 900 + "]" * 900, "found lists or mappings nested too deeply to be read"),
            ("", "op: expected one of isolate, freeze"),
        ],
    )
    def test_one_line_that_is_wrong_is_said_too(self, line, message):
        with pytest.raises(ValueError) as error:  # noqa: PT011
            parse_op(line)
        assert message in str(error.value)

    @pytest.mark.parametrize("depth", [10, 30, 60, 90, 120, 200, 1000])
    def test_edits_in_edits_are_read_or_refused(self, depth):
        """Wherever it is that Python cannot follow any more."""
        line = "{op: composite, parts: 1, from_run: a, edits: [" * depth + "]}" * depth
        try:
            script = parse_script(f"edits: [{line}]")
        except ValueError as error:
            assert str(error) == "expected edits, found lists or mappings nested too deeply to be read"  # noqa: PT017
        else:
            assert parse_script(to_yaml(script)) == script

    @pytest.mark.parametrize("operation", OPERATIONS)
    def test_a_line_to_begin_with_is_an_edit(self, operation):
        edit = parse_op(example_line(operation, "[lid, part 2]"))
        assert type(edit) is OPERATIONS[operation]
        assert edit.parts == ("lid", "part 2")
        keys = {key for line in describe_operation(operation)[1:] for key in line.split(":")[0].split(", ")}
        assert keys == {key_of(f) for f in fields(edit)}

    def test_a_line_has_what_an_operation_is_about(self):
        assert example_line("echo", "lid") == "echo:parts=lid,copies=3,every=0.2,fade=0.5"
        assert example_line("move", "all") == "move:parts=all,by=[0,0,0.1]"
        assert describe_operation("speed")[1] == (
            "factor: a factor from 0.01 to 100, or from -0.01 to -100 for backwards"
        )
        assert describe_operation("speed")[3] == "from, to: seconds from the film's start, 0 or more"


numbers = st.floats(0.01, 50.0)
vectors = st.tuples(*[st.floats(-9, -0.1) | st.floats(0.1, 9)] * 3)
parts = st.lists(st.sampled_from([0, 1, 17, "drawer", "all", "no", "3", "tür: a"]), min_size=1).map(tuple)
since = st.one_of(st.just({}), st.just({"begin": 0.0}), numbers.map(lambda x: {"begin": x, "end": 2 * x}))
made = {
    Isolate: {"at": st.none() | numbers},
    Freeze: {"at": st.none() | numbers},
    Speed: {"factor": numbers | numbers.map(lambda x: -x)},
    Loop: {"times": st.none() | st.integers(1, 9), "bounce": st.booleans()},
    Ghost: {"opacity": st.floats(0, 1)},
    Fade: {"opacity": st.floats(0, 1), "ease": numbers},
    Echo: {"copies": st.integers(1, 9), "every": numbers, "fade": st.floats(0, 1)},
    Scale: {"factor": numbers},
    Move: {"by": vectors},
    Rotate: {"axis": vectors, "degrees": st.floats(-360, 360), "about": st.none() | vectors},
    Redirect: {"axis": vectors, "degrees": numbers, "about": st.none() | vectors, "at": st.none() | numbers},
    Amplify: {"factor": numbers, "at": st.none() | numbers},
}
entries = st.one_of(
    st.fixed_dictionaries({"kind": st.just(kind), "parts": parts, "when": since, **keys})
    for kind, keys in made.items()
)
composites = st.fixed_dictionaries(
    {
        "kind": st.just(Composite),
        "parts": parts,
        "when": since,
        "from_run": st.text("a/ß: #'\"{", min_size=1),
        "place": st.fixed_dictionaries(
            {"to": st.none() | vectors, "axis": vectors, "degrees": numbers, "scale": numbers}
        ),
        "edits": st.lists(entries, max_size=2),
    }
)


def made_up(kind, when, place=None, edits=(), **keys):
    """An edit of what was drawn."""
    if kind is Composite:
        keys |= {"place": Place(**place), "edits": tuple(made_up(**one) for one in edits)}
    return kind(**when, **keys)


@given(st.lists(entries | composites, max_size=4), st.none() | st.floats(0.1, 60.0), st.none() | numbers)
def test_what_is_saved_is_read_again(drawn, fps, length):
    script = Script(fps=fps, length=length, edits=tuple(made_up(**one) for one in drawn))
    assert parse_script(to_yaml(script)) == script


def test_every_operation_is_saved_by_the_test_above():
    assert {*made, Composite} == set(OPERATIONS.values())


def test_what_is_as_ever_is_not_written():
    text = to_yaml(Script(edits=(Loop(parts=(1,), begin=0.5), Fade(parts=("lid",), opacity=0.5))))
    assert text == (
        "edits:\n- op: loop\n  parts: [1]\n  from: 0.5\n- op: fade\n  parts: [lid]\n  opacity: 0.5\n"
    )
