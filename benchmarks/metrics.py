"""The metric contract: what was measured, which way is better, how far it may move before that is news."""

import datetime
import subprocess
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from gsjax.engine import machine

DIRECTIONS = ("lower", "higher", "same")
DIGITS = 6


@dataclass(frozen=True)
class Metric:
    """One figure of a run.

    Attributes:
        key: workload/program/figure.
        value: the figure.
        unit: of the value.
        direction: "lower" or "higher" is better, or it should stay the "same".
        rel_tol: relative change that is no news.
        travels: it means the same on another machine of the same kind of device.
        noisy: the machine was disturbed: the figure is shown, and neither judged nor kept as a baseline.
    """

    key: str
    value: float
    unit: str
    direction: str
    rel_tol: float
    travels: bool = False
    noisy: bool = False

    def __post_init__(self):
        if self.direction not in DIRECTIONS:
            raise ValueError(f"{self.key}: direction {self.direction!r} is none of {', '.join(DIRECTIONS)}")
        if self.rel_tol < 0:
            raise ValueError(f"{self.key}: rel_tol {self.rel_tol} must not be negative")


class Row(NamedTuple):
    """One metric against its baseline."""

    key: str
    unit: str
    value: float | None
    baseline: float | None
    verdict: str  # better, same, worse, new, missing, noisy, or elsewhere (measured on another machine)

    @property
    def change(self) -> float | None:
        """Relative to the baseline."""
        if self.value is None or not self.baseline:
            return None
        return self.value / self.baseline - 1


FAILING = ("worse", "missing")


def rounded(value: Any) -> Any:
    """Six significant digits: noise in the others would only make differences in git."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def make_record(metrics: Iterable[Metric], **details: Any) -> dict[str, Any]:
    """Machine, versions, date and metrics, ready for JSON."""
    stored = {metric.key: asdict(metric) for metric in metrics}
    for entry in stored.values():
        del entry["key"]
    here = machine.describe()
    return rounded(
        {
            "machine": here,
            "machine_name": machine.name(here),
            "versions": {name: version(name) for name in ("gsjax", "jax", "jaxlib", "numpy")},
            "commit": _commit(),
            "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M"),
            "metrics": stored,
            **details,
        }
    )


def read_metrics(record: dict[str, Any]) -> dict[str, Metric]:
    """The metrics of a record, by key.

    Raises:
        ValueError: an entry is no metric.
    """
    try:
        return {key: Metric(key, **entry) for key, entry in record["metrics"].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected metrics of the benchmark suite, found something else: {error}") from error


def judge(now: Metric, before: Metric) -> str:
    """better, same or worse; what is allowed is the tolerance of the newer one."""
    change = now.value - before.value
    if abs(change) <= now.rel_tol * abs(before.value):
        return "same"
    if now.direction == "same":
        return "worse"
    return "better" if (change < 0) == (now.direction == "lower") else "worse"


def compare(record: dict[str, Any], baseline: dict[str, Any]) -> list[Row]:
    """Every metric of `record` against the baseline.

    A metric that the baseline has and a workload of this run no longer gives is missing; workloads that did
    not run are passed over. On another machine only what travels is judged.
    """
    now, before = read_metrics(record), read_metrics(baseline)
    same_machine = record["machine_name"] == baseline["machine_name"]
    rows = []
    for key, metric in sorted(now.items()):
        old = before.get(key)
        if old is None:
            verdict = "new"
        elif metric.noisy:
            verdict = "noisy"
        elif not (same_machine or metric.travels):
            verdict = "elsewhere"
        else:
            verdict = judge(metric, old)
        rows.append(Row(key, metric.unit, metric.value, None if old is None else old.value, verdict))
    ran = {key.split("/")[0] for key in now}
    gone = (m for key, m in sorted(before.items()) if key not in now and key.split("/")[0] in ran)
    return rows + [Row(metric.key, metric.unit, None, metric.value, "missing") for metric in gone]


def merged(record: dict[str, Any], baseline: dict[str, Any] | None) -> dict[str, Any]:
    """The new baseline: what this run measured without noise, and the old figures of what did not run.

    Raises:
        ValueError: the old figures are of another machine, so the two cannot stand in one file.
    """
    metrics = {k: m for k, m in record["metrics"].items() if not m["noisy"]}
    if baseline is not None:
        ran = {key.split("/")[0] for key in record["metrics"]}
        # A figure that was noisy this time stays as it was; one that is no longer measured goes.
        kept = {
            key: metric
            for key, metric in read_metrics(baseline).items()
            if key in record["metrics"] or key.split("/")[0] not in ran
        }
        elsewhere = baseline["machine_name"] != record["machine_name"]
        if elsewhere and set(kept) - set(metrics):
            raise ValueError(
                f"the baseline is of {baseline['machine_name']}, this is {record['machine_name']}, and not "
                "all was measured here (a part of the suite, or noise); run all of it to replace the baseline"
            )
        metrics = {key: baseline["metrics"][key] for key in kept} | metrics
    head = ("machine", "machine_name", "versions", "commit", "date")
    return {key: record[key] for key in head} | {"metrics": metrics}


def _commit() -> str:
    """The checkout's commit, with a + where files differ from it; empty without git."""
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--dirty=+"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return run.stdout.strip()
