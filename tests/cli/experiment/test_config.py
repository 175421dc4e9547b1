"""Each way in which a config can be wrong, and experiments that do not exist."""

from pathlib import Path

import pytest
import yaml

from tests.cli.experiment.toys import CONFIG, SCRIPT, calls


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"without": "claim"}, "config.yaml: claim: expected text, found nothing"),
        ({"source": "  "}, "config.yaml: source: expected text, found none"),
        (
            {"script": "gone.py"},
            "config.yaml: script: expected a file, found none at experiments/toy/gone.py",
        ),
        (
            {"script": "../../sweep.py"},
            "config.yaml: script: expected a path within experiments, found ../../sweep.py",
        ),
        (
            {"without": "grid"},
            "config.yaml: grid: expected option: [values], or cases, found nothing to sweep",
        ),
        ({"grid": {}}, "config.yaml: grid: expected option: [values], or cases, found nothing to sweep"),
        ({"grid": None}, "config.yaml: grid: expected key: value pairs, found nothing"),
        ({"grid": {"size": []}}, "config.yaml: grid.size: expected a list of values, found []"),
        ({"grid": {"size": 320}}, "config.yaml: grid.size: expected a list of values, found 320"),
        (
            {"grid": {"size": [{"w": 1}]}},
            'grid.size: expected numbers, text, true, false, null, or lists of those, found {"w": 1}',
        ),
        (
            {"grid": {"rate": ["1e-3"]}},
            "grid.rate: expected a number as YAML has it, with a point and a sign (1.0e-3), found 1e-3",
        ),
        ({"grid": {"rate": [float("nan")]}}, "grid.rate: expected finite numbers, found NaN"),
        (
            {"grid": {"size": [1, 2, 1]}},
            "grid, cases and seeds: expected each once, found size=1 seed=0 more than once",
        ),
        ({"grid": {"seed": [1]}}, "grid.seed: expected an option's name, found seed"),
        ({"grid": {3: [1]}}, "grid.3: expected an option's name, found 3"),
        ({"cases": [3]}, "config.yaml: cases[0]: expected option: value pairs, found 3"),
        ({"cases": [{"size": 1}]}, "cases[0].size: expected an option that the grid has not, found size"),
        ({"seeds": 3}, "config.yaml: seeds: expected a list, found 3"),
        ({"seeds": []}, "config.yaml: seeds: expected a list of whole numbers, found []"),
        ({"seeds": [0, "a"]}, 'config.yaml: seeds: expected a list of whole numbers, found [0, "a"]'),
        ({"version": True}, "config.yaml: version: expected a whole number, found true"),
        (
            {"sedes": [1]},
            "seeds, columns, figure, version, found 'sedes'; did you mean 'seeds'?",
        ),
        ({"columns": ["ms"]}, "columns[0]: expected the keys key, label, unit, direction, format, found ms"),
        ({"columns": [{"label": "x"}]}, "config.yaml: columns[0].key: expected text, found nothing"),
        (
            {"columns": [{"key": "ms", "direction": "up"}]},
            "columns[0].direction: expected lower or higher, found up",
        ),
        (
            {"columns": [{"key": "ms", "format": "pretty"}]},
            "columns[0].format: expected one of Python's for a number, such as .2f, found pretty",
        ),
        ({"columns": [{"key": "ms"}, {"key": "ms"}]}, "columns: expected each once, found ms more than once"),
        (
            {"figure": {"file": "../x.png"}},
            "figure.file: expected a file name in .png, .svg, .jpg, .webp, found ../x.png",
        ),
        (
            {"figure": {"file": "x.pdf"}},
            "figure.file: expected a file name in .png, .svg, .jpg, .webp, found x.pdf",
        ),
        (
            {"figure": {"caption": "x"}},
            "sweep.py: expected a function figure(rows, path), which the config describes, found none",
        ),
        (
            {"text": "x = 1"},
            "sweep.py: expected a function run(options, seed, folder), found none",
        ),
        (
            {"text": "def run(:"},
            "sweep.py: expected a script that can be loaded, found SyntaxError: invalid syntax",
        ),
        ({"text": "import nowhere"}, "found ModuleNotFoundError: No module named 'nowhere'"),
        ({"text": "exit(3)"}, "sweep.py: expected a script that can be loaded, found SystemExit: 3"),
    ],
)
def test_a_bad_config_is_one_sentence(toy, gsjax, changes, says):
    toy(**changes)
    code, out, err = gsjax("run", "toy")
    assert (code, out, calls()) == (2, "", [])
    assert err.count("error:") == err.count("\n") == 1
    assert err.startswith("error: experiments/toy/")
    assert says in err


@pytest.mark.parametrize(
    "text",
    ["claim: [", "claim: a: b", "- 1", "", "claim: \x00", "source: 2024-02-30", "claim: " + 2000 * "["],
    ids=range(7),
)
def test_a_config_that_is_no_mapping(toy, gsjax, text):
    (toy() / "config.yaml").write_text(text)
    code, _, err = gsjax("run", "toy")
    assert code == 2
    assert "experiments/toy/config.yaml: expected " in err


@pytest.mark.parametrize("name", ["sweep.py", "helper.py"])
def test_a_script_is_in_the_encoding_that_it_declares(toy, gsjax, name):
    path = toy() / name
    path.write_bytes(SCRIPT.encode() + b"# caf\xe9\n")
    code, _, err = gsjax("run", "toy")
    assert code == 2
    expected = "expected a script in UTF-8, or in the encoding that it declares, found a fault: "
    assert f"experiments/toy/{name}: {expected}" in " ".join(err.split())
    path.write_bytes(b"# -*- coding: latin-1 -*-\n" + path.read_bytes())
    assert gsjax("run", "toy")[0] == 0


def test_list_shows_the_sound_ones_beside_a_broken_one(toy, gsjax):
    toy()
    for name in ("broken", "paper/nested"):
        folder = Path("experiments") / name
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(yaml.safe_dump({**CONFIG, "claim": f"That of {name}."}))
    (folder / "sweep.py").write_text(SCRIPT)
    code, out, err = gsjax("list")
    assert code == 2
    assert "experiments/broken/config.yaml: script" in err
    lines = {line.split()[0]: line for line in out.splitlines()}
    assert "Larger pictures take longer." in lines["toy"]
    assert "0 of 4" in lines["paper/nested"]
    assert "broken" not in lines
    assert gsjax("run", "paper/nested")[0] == 0
    assert "4 of 4" in gsjax("list")[1]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("list", "--root", "nowhere"),
            "nowhere: expected a folder of experiments (--root names another), found none there",
        ),
        (("run", "../toy"), "experiments: no experiment '../toy'; available: toy"),
        (("run", "to"), "experiments: no experiment 'to'; available: toy"),
        (("table", "tyo"), "experiments: no experiment 'tyo'; available: toy"),
    ],
)
def test_what_is_not_there(toy, gsjax, arguments, says):
    toy()
    code, _, err = gsjax(*arguments)
    assert code == 2
    assert says in err
