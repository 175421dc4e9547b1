"""A toy experiment in a new working directory, and `gsjax experiment` to run it."""

from pathlib import Path

import pytest
import yaml

from gsjax.cli import main
from tests.cli.experiment.toys import CONFIG, SCRIPT


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """Writes experiments/toy/ in a new working directory; returns its folder."""
    monkeypatch.chdir(tmp_path)
    folder = Path("experiments/toy")
    folder.mkdir(parents=True)

    def write(text: str = SCRIPT, without: str = "", **changes) -> Path:
        config = {key: value for key, value in {**CONFIG, **changes}.items() if key != without}
        (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
        (folder / "sweep.py").write_text(text)
        return folder

    return write


@pytest.fixture
def gsjax(capfd):
    """Runs `gsjax experiment`; returns the exit code, and what stdout and stderr said."""

    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(["experiment", *arguments])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call
