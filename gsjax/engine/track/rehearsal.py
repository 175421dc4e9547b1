"""The tracker's programs, compiled or loaded by a second thread while the first scene is fitted."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from gsjax.engine.drive import Tick
from gsjax.engine.track.tracking import first_update
from gsjax.methods.track import TrackConfig, TrackedScene
from gsjax.methods.track.budget import first_rung
from gsjax.scene.frame import Frame


@dataclass
class Rehearsal:
    """An update of a scene that is not fitted yet, but already has the array shapes of the fitted one.

    Args:
        first: the first frame, which also stands for the second.
        config: settings of the tracker.
        budgeted: whether the settings will be chosen for a budget.
        needed: whether there will be an update at all.
    """

    first: Frame
    config: TrackConfig
    budgeted: bool = False
    needed: bool = True
    _job: Future | None = field(default=None, init=False)

    def begin(self, scene: TrackedScene) -> None:
        """Begin the update of `scene` on a thread of its own."""
        if not self.needed:
            return
        config = first_rung(self.config, len(self.first.images)) if self.budgeted else self.config
        executor = ThreadPoolExecutor(1, thread_name_prefix="rehearsal")
        self._job = executor.submit(first_update, scene, self.first, config)
        executor.shutdown(wait=False)

    def tick(self) -> Tick | None:
        """The tick of the rehearsal, once it has ended; None if there was none or it failed, because the
        tracker's own update will then say why."""
        return None if self._job is None or self._job.exception() else self._job.result()
