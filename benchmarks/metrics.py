"""The metric contract: what was measured, which direction is better, and which changes are significant."""

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
        unit: unit of the value.
        direction: whether "lower" or "higher" is better, or the value should stay the "same".
        rel_tol: largest relative change that is insignificant.
        travels: the figure is comparable across machines with the same kind of device.
        noisy: the machine was disturbed; the figure is shown, but neither judged nor kept as a baseline.
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
            raise ValueError(
                f"{self.key}: expected direction {', '.join(DIRECTIONS)}, found {self.direction!r}"
            )
        if self.rel_tol < 0:
            raise ValueError(f"{self.key}: expected rel_tol of 0 or more, found {self.rel_tol}")


class Row(NamedTuple):
    """One metric compared with its baseline."""

    key: str
    unit: str
    value: float | None
    baseline: float | None
    verdict: str  # better, same, worse, new, missing, noisy, or elsewhere (measured on another machine)

    @property
    def change(self) -> float | None:
        """Relative change from the baseline."""
        if self.value is None or not self.baseline:
            return None
        return self.value / self.baseline - 1


FAILING = ("worse", "missing")


def rounded(value: Any) -> Any:
    """Round to six significant digits; noise in the others would only clutter diffs."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def make_record(metrics: Iterable[Metric], **details: Any) -> dict[str, Any]:
    """Machine, versions, date and metrics as a dictionary for JSON."""
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
        ValueError: an entry is not a metric.
    """
    try:
        return {key: Metric(key, **entry) for key, entry in record["metrics"].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected metrics of the benchmark suite, found something else: {error}") from error


def judge(now: Metric, before: Metric) -> str:
    """better, same or worse, by the tolerance of the newer metric."""
    change = now.value - before.value
    if abs(change) <= now.rel_tol * abs(before.value):
        return "same"
    if now.direction == "same":
        return "worse"
    return "better" if (change < 0) == (now.direction == "lower") else "worse"


def compare(record: dict[str, Any], baseline: dict[str, Any]) -> list[Row]:
    """Every metric of `record` against the baseline.

    A metric of the baseline that a workload of this run no longer reports is missing; workloads that did not
    run are skipped. On another machine only metrics that travel are judged.
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
    """The new baseline: this run's figures without noise, and the old ones of workloads that did not run.

    Raises:
        ValueError: the old figures are from another machine, so the two cannot be combined.
    """
    metrics = {k: m for k, m in record["metrics"].items() if not m["noisy"]}
    if baseline is not None:
        ran = {key.split("/")[0] for key in record["metrics"]}
        # A figure that was noisy this time keeps its old value; one that is no longer measured is dropped.
        kept = {
            key: metric
            for key, metric in read_metrics(baseline).items()
            if key in record["metrics"] or key.split("/")[0] not in ran
        }
        elsewhere = baseline["machine_name"] != record["machine_name"]
        if elsewhere and set(kept) - set(metrics):
            raise ValueError(
                f"expected a baseline from this machine ({record['machine_name']}), found one from "
                f"{baseline['machine_name']}; run the whole suite without noise to replace it"
            )
        metrics = {key: baseline["metrics"][key] for key in kept} | metrics
    head = ("machine", "machine_name", "versions", "commit", "date")
    return {key: record[key] for key in head} | {"metrics": metrics}


def _commit() -> str:
    """The checkout's commit, followed by + if files differ from it; empty without git."""
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
