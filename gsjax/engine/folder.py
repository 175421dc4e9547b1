"""The folder of a run: its files, and when it may be overwritten."""

import dataclasses
import enum
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml

from gsjax.engine.locks import LOCK, lock, locked
from gsjax.io.atomic import atomic_write, write_json, write_npz
from gsjax.io.brief import brief
from gsjax.io.labels import ENDING
from gsjax.io.parsed import parse_json, parse_yaml
from gsjax.io.scenes import is_scene
from gsjax.io.sequences import scenes_in_words, scenes_within

DEFORMATION = "deformation.npz"  # the scene of a run of `gsjax deform` over time
_WRITTEN = (
    *("config.yml", "metrics.json", "metrics.jsonl", "report.html", "trajectory.npz", "scene.ply"),
    *("cameras.npz", "poses.npz", "parts.npz", "field.npz", DEFORMATION, "video_*.mp4", ".*.partial*"),
    *("canonical", "renders", "plots", "query", "grasp", "eval", "edit", "field", "tensorboard", "test"),
    *("scene_labels.npz", "mask.png", "resume"),
)
"""All that a run, and commands that use the run, write into its folder; `screenshots` are kept."""
_VALUABLE = ("metrics.json", "trajectory.npz", "scene.ply", "canonical/scene.ply", "field.npz", DEFORMATION)
"""Results that make an unfinished run worth keeping."""
_RESUMED = ("resume/*", "canonical/resume/*", "canonical/scene.ply")
"""What a run resumes from; a run of `gsjax parts` contains a fit, which may be all that is there."""
OF_QUERY = ("query.json", "selection.npz", "over_time.npz", "masks", "frames", "video.mp4", "overview.png")
OF_QUERY += ("object.ply", "without.ply", "recolored.ply", "moved.ply", f"*{ENDING}")
"""The files that `gsjax query` writes."""
SCRIPT = "edit.yaml"  # the edits of a film of `gsjax edit`; it marks the film's folder
_DISPOSABLE = (LOCK, ".*.partial*", ".DS_Store", "._*", ".nfs*", ".directory")
"""Hidden files that may be deleted: of killed commands, and of file managers and file systems."""
_ADVICE = "restore it, or replace the run with --overwrite"
SIGNATURE = "# gsjax run"  # the first line of config.yml, because other programs write files of that name too


def read_values(file: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    """Read a file in which a run stored named values.

    Args:
        file: the file.
        parse: parser of its text, `parse_json` or `parse_yaml`.

    Raises:
        ValueError: the file holds something else.
    """
    try:
        found = parse(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{file}: expected what a run wrote, found other text ({error}); {_ADVICE}"
        ) from error
    if not isinstance(found, dict):
        raise ValueError(f"{file}: expected names and values, found {brief(repr(found))}; {_ADVICE}")
    return found


def is_run(folder: Path) -> bool:
    """Whether a folder holds the settings of a run."""
    config = folder / "config.yml"
    return config.is_file() and config.read_bytes().startswith(SIGNATURE.encode())


def is_of_run(file: Path) -> bool:
    """Whether a file is one that a run has written into its folder."""
    return file.is_file() and is_run(file.parent) and any(fnmatch(file.name, each) for each in _WRITTEN)


def is_finished(folder: Path) -> bool:
    """Whether a run was not stopped and has written everything: its report comes last."""
    metrics = folder / "metrics.json"
    if not metrics.is_file():
        return False
    found = read_values(metrics, parse_json)
    written = (folder / "report.html").is_file() or not found.get("report", True)
    return found.get("complete", True) and written


def is_resumable(folder: Path) -> bool:
    """Whether a run left anything to resume from."""
    return any(any(folder.glob(pattern)) for pattern in _RESUMED)


def expect_run(path: Path, made_by: str = "") -> None:
    """Raises FileNotFoundError if this is not the folder of a run (of the command `made_by`)."""
    expect_folder(path, made_by)
    if not is_run(path):
        found, advice = "other files" if is_nonempty(path) else "an empty folder", "give a run's --out"
        if scenes := scenes_within(path):
            found, advice = scenes_in_words(scenes), "give a file, or a folder of nothing but numbered ones"
        raise FileNotFoundError(
            f"{_wanted(path, made_by)}, whose config.yml begins with {SIGNATURE!r}, found {found}; {advice}"
        )


def expect_folder(path: Path, made_by: str = "") -> None:
    """Raises FileNotFoundError if this is not a folder."""
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing there"
        raise FileNotFoundError(f"{_wanted(path, made_by)}, found {found}; give a run's --out")


def _wanted(path: Path, made_by: str) -> str:
    return f"{path}: expected the folder of a run" + (f" of {made_by}" if made_by else "")


def expect_dataset(path: str) -> None:
    """Raises ValueError if the path is a run's folder or a file of Gaussians instead of a dataset."""
    if is_run(Path(path)):
        raise ValueError(
            f"{path}: expected a dataset, found the folder of a run; open its report.html, or view it with "
            f"gsjax view {path}"
        )
    if is_scene(path) and Path(path).is_file():
        raise ValueError(
            f"{path}: expected a dataset, found a file of Gaussians; view it with gsjax view {path}"
        )


class RunFolder:
    """A run on disk. Files are replaced atomically, so a stopped run is as readable as a finished one.

        RUN/
          config.yml              the settings, written first; its first line marks the folder as a run's
          metrics.json            every score; what could not be computed is null
          metrics.jsonl           of a fit: loss, PSNR, number of Gaussians during the fit, one row per line
          trajectory.npz          means [T,N,3], quats [T,M,4], normals [M,3], labels [N], label_ids [K+1],
                                  times [T], update_s [T], lost [T,K], turn_known [T,K]
          parts.npz               of `gsjax parts`: anchor, means0 [N,3], weights [N,P], labels [N],
                                  centres [P,3], R [T,P,3,3], t [T,P,3], times [T]
          field.npz               of `gsjax distill`: features of places, and what they mean
          deformation.npz         of `gsjax deform`: the canonical scene, its features, and its motion
          scene.ply               the Gaussians: of a fit, or of the first (or canonical) frame
          scene_labels.npz        labels [N] of these, where there are any
          canonical/              of `gsjax parts`: the fit of its canonical frame, a run of its own
          cameras.npz             of a fit that learned them: names [V], viewmats [V,4,4], exposures [V,3,4]
          poses.npz               of `gsjax deform --deform.refine-poses`: viewmats [T,4,4] as refined
          renders/CAM/FRAME.png   rendered images; of a fit renders/held_out/NUMBER.png, beside the truth
          video_CAM.mp4           input, render, error and labels side by side; of a fit video_orbit.mp4
          plots/NAME.svg|png      update time, error over frames, ...
          report.html             everything on one page, written last
          screenshots/            pictures saved from `gsjax view`; --overwrite keeps them
          resume/                 what an unfinished run resumes from; a finished one has none
          query/, grasp/, eval/   results of `gsjax query`, `gsjax grasp` and `gsjax eval`
          field/                  of `gsjax distill`: a run of its own
          test/FRAME.png          of `gsjax deform`: held-out frames as the scene renders them
          edit/NAME/              of `gsjax edit`: video.mp4, edit.yaml, metrics.json, perhaps ply/FRAME.ply
          tensorboard/            of a fit with --tensorboard: its event files

    A run is finished when it has its report, and its metrics.json does not say that it was stopped.

    Attributes:
        path: the folder, which exists once settings are written.
        config, metrics, metrics_lines, scene, report: paths of its files, as above.
        resume: folder of what an unfinished run resumes from.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False, resume: bool | None = False):
        """Claim the folder. It is created, and what an earlier run left in it is removed, only when this run
        writes its settings.

        Args:
            path: a folder that does not exist, is empty, or holds an earlier run.
            overwrite: replace an earlier run even if it is finished or could be resumed. Files that no run
                writes are kept.
            resume: keep an unfinished run. None for commands that cannot resume.

        Raises:
            FileNotFoundError: `resume` is on and no run is there.
            FileExistsError: the folder holds a finished run and `overwrite` is off; an unfinished run with
                results and both are off; or something that is not a run. It is left untouched.
            NotADirectoryError: `path` is a file.
            ValueError: both `resume` and `overwrite` are on.
        """
        self.path, self._stale = Path(path), False
        self.config, self.resume = self.path / "config.yml", self.path / "resume"
        self.metrics, self.metrics_lines = self.path / "metrics.json", self.path / "metrics.jsonl"
        self.scene, self.report = self.path / "scene.ply", self.path / "report.html"
        if resume and overwrite:
            raise ValueError(
                "--resume and --overwrite: one continues a run, the other replaces it; choose one"
            )
        if resume and not self.config.is_file():
            raise FileNotFoundError(f"{self.path}: expected a run to resume, found none; leave out --resume")
        if self.path.exists() and not self.path.is_dir():
            raise NotADirectoryError(f"{self.path}: expected a folder, found a file; name another folder")
        if self.path.is_dir() and is_nonempty(self.path):
            self._claim(overwrite, resume)

    @classmethod
    def locked(cls, path: Path, *, overwrite: bool = False, resume: bool | None = False) -> "RunFolder":
        """Claim the folder, and lock it against other writers until the command ends (`gsjax.engine.locks`).
        If it lies within another run, as a field does, that run cannot be replaced meanwhile.

        Args:
            path, overwrite, resume: as for `RunFolder`.

        Raises:
            BlockingIOError: another process writes into it.
            OSError, ValueError: as for `RunFolder`; or the folder cannot be made or written.
        """
        if is_run(path.parent):
            lock(path.parent, shared=True)
        lock(path)
        return cls(path, overwrite=overwrite, resume=resume)

    def _claim(self, overwrite: bool, resume: bool | None) -> None:
        # config.yml is written first, so a folder without it is not a run: delete nothing there.
        if not is_run(self.path):
            raise FileExistsError(
                f"{self.path}: expected a new folder, an empty one or one of a run (whose config.yml begins "
                f"with {SIGNATURE!r}), found other files; name another folder"
            )
        if not overwrite and is_finished(self.path):
            nothing = ", of which nothing is left to resume" if resume else ""
            raise FileExistsError(
                f"{self.path}: holds a finished run{nothing}; name another folder, or replace it with "
                "--overwrite"
            )
        resumable = is_resumable(self.path)
        valuable = resumable or any((self.path / name).exists() for name in _VALUABLE)
        if valuable and not (resume or overwrite):
            advice = "continue it with --resume, or " if resumable and resume is not None else ""
            raise FileExistsError(
                f"{self.path}: holds an unfinished run; {advice}replace it with --overwrite"
            )
        self._stale = not resume

    def forget_resume(self) -> None:
        """Remove what only an unfinished run needs."""
        shutil.rmtree(self.resume, ignore_errors=True)

    def render(self, camera: int | str, frame: int) -> Path:
        """Path of the rendered image of a camera (its id) at a frame; its folder exists."""
        path = self.path / "renders" / str(camera) / f"{frame:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def video(self, camera: int | str) -> Path:
        """Path of the side-by-side video of a camera."""
        return self.path / f"video_{camera}.mp4"

    def plot(self, name: str, suffix: str = ".svg") -> Path:
        """Path of the plot `name`; its folder exists."""
        path = self.path / "plots" / f"{name}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_config(self, config: Any) -> None:
        """Write config.yml from a dataclass instance, nested ones included, and remove an earlier run.

        Raises:
            TypeError: `config` is not a dataclass instance.
        """
        text = yaml.safe_dump(plain(dataclasses.asdict(config)), sort_keys=False, allow_unicode=True)
        # config.yml is replaced and not removed: without it, a removal that is stopped would leave no run.
        stale = [name for name in _WRITTEN if name != self.config.name] if self._stale else []
        for name in stale:
            for entry in self.path.glob(name):
                shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()
        self._stale = False
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise type(error)(f"{self.path}: cannot make this folder ({error.strerror})") from error
        self.report.unlink(missing_ok=True)  # of an incomplete run: a report marks a run as finished
        with atomic_write(self.config) as temporary:
            temporary.write_text(f"{SIGNATURE}\n{text}", encoding="utf-8")

    def setting(self, name: str) -> Any:
        """A setting of config.yml."""
        return flattened(read_values(self.config, parse_yaml)).get(name)

    def check_config(self, config: Any, *, but: tuple[str, ...]) -> None:
        """Raises ValueError if config.yml differs from `config` in settings other than `but`; those that the
        version that wrote it did not have are ignored."""
        stored = flattened(read_values(self.config, parse_yaml))
        given = flattened(plain(dataclasses.asdict(config)))
        names = [name for name in stored if name.split(".")[0] not in but]
        others = [name for name in names if stored[name] != given.get(name)]
        if others:
            words = [f"{n} {stored[n]!r}, now it is {given.get(n)!r}" for n in others]
            raise ValueError(
                f"--resume: the run in {self.path} was started with {'; with '.join(words)}. Use the same, "
                "or replace the run with --overwrite instead"
            )

    def write_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write metrics.json; numbers that are not finite become null."""
        write_json(self.metrics, metrics)

    def write_trajectory(self, **arrays: Any) -> None:
        """Write trajectory.npz."""
        write_npz(self.path / "trajectory.npz", arrays)


@contextmanager
def replaced_folder(path: Path, written: Sequence[str]) -> Iterator[Path]:
    """A new folder to write into, which replaces what gsjax left at `path` earlier if the block succeeds.
    Until then, and after an exception (Ctrl-C too), the earlier folder stays as it was. Meanwhile no other
    process can write a folder of that name, or replace the run that contains it.

    Args:
        path: the folder.
        written: names or patterns of what gsjax writes there; the first is always there.

    Raises:
        FileExistsError: something else is there; nothing of it is touched.
        BlockingIOError: another process writes there.
    """
    path = expect_replaceable(path, written)
    with locked(path.parent, shared=True), locked(path.parent, path.name):
        yield from _replaced(path)


def _replaced(path: Path) -> Iterator[Path]:
    new, old = (path.with_name(f".{path.name}.{os.getpid()}.partial{which}") for which in ("", "_old"))
    for stale in (new, old):  # of a killed process with the same number
        shutil.rmtree(stale, ignore_errors=True)
    try:
        new.mkdir(parents=True)
    except OSError as error:
        raise type(error)(f"{path}: cannot write beside it ({error.strerror})") from error
    try:
        yield new
        if path.exists():
            path.rename(old)
        new.rename(path)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if old.exists():
            shutil.rmtree(old) if path.exists() else old.rename(path)


def expect_replaceable(path: Path, written: Sequence[str]) -> Path:
    """The folder, with links resolved, if it may be replaced.

    Raises:
        FileExistsError: something is there that gsjax did not write.
    """
    path = path.resolve()
    if not path.exists():
        return path
    entries = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else []
    others = [name for name in entries if not any(fnmatch(name, each) for each in (*written, *_DISPOSABLE))]
    if path.is_dir() and not others and (not entries or any(fnmatch(n, written[0]) for n in entries)):
        return path
    found = "a file" if not path.is_dir() else (others or [f"no {written[0]}"])[0]
    raise FileExistsError(
        f"{path}: expected nothing, or only what gsjax writes there itself; found {found}; move it elsewhere"
    )


def is_nonempty(folder: Path) -> bool:
    """Whether a folder holds anything but the lock of a command that is running or was killed."""
    return any(entry.name != LOCK for entry in folder.iterdir())


def flattened(settings: Mapping[str, Any], within: str = "") -> dict[str, Any]:
    """Nested settings, keyed by their option names on the command line: fit.start.count."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= flattened(value, f"{within}{name}.") if isinstance(value, Mapping) else {within + name: value}
    return flat


def plain(value: Any) -> Any:
    """`value` in the types of YAML: paths as text, enums as their values, tuples as lists."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy and JAX arrays and scalars
        return value.tolist()
    if isinstance(value, enum.Enum):
        return plain(value.value)
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)
