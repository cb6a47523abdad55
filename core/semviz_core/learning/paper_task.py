"""Training of the paper's matcher and those it is compared with: its losses, its schedule."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.learning.batch import Batch, BatchTruth
from semviz_core.learning.coarse import start_poses
from semviz_core.learning.drills import PAPER_DRILLS
from semviz_core.learning.losses import correspondence_loss, pose_loss, whole_loss
from semviz_core.learning.models import MODELS, options_of
from semviz_core.learning.networks.streams import GraphMatcher
from semviz_core.learning.pnpl import differentiable_pnpl
from semviz_core.learning.sample import Sample
from semviz_core.learning.schedule import cosine
from semviz_core.learning.splitting import split_lines
from semviz_core.learning.task import Progress, SampleSource

PAPER_SAMPLES = 596_800
"""200 epochs of the paper's 2984 frames."""
POSE_FROM = 120 / 200
"""From this share of the training on, the pose loss counts too."""
_FEW = 5


class PaperTask:
    """A matcher of ``MODELS`` on frames with their answers."""

    samples = PAPER_SAMPLES

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.model = MODELS[name]
        self.network = GraphMatcher(self.model, len(classes))
        made_with = options_of(name, [one.name for one in classes])
        self.options: dict[str, Any] = {**made_with, "data": source.describe()}

    def learning_rate(self, progress: Progress) -> float:
        """The paper's at most; it does not say that its rate falls."""
        return cosine(progress)

    def make(self, number: int) -> Sample:
        return self._of(self.source.sample(number))

    def held_out(self, number: int) -> Sample:
        return self._of(self.source.held_out(number))

    def _of(self, sample: Sample) -> Sample:
        return sample if self.model.lines else split_lines(sample)

    def collate(self, items: Sequence[Sample]) -> Batch:
        return Batch.of(items)

    def losses(self, together: Batch, progress: Progress) -> dict[str, Tensor]:
        """Eq. 11; gamma is 0 at first, then 1."""
        P = self.network(together).probability
        truth = _truth(together)
        possible = self.network.possible(together)
        correspondence = correspondence_loss(P, truth.pairs, possible)
        if progress.share < POSE_FROM:
            return {"loss": correspondence.mean()}
        start = start_poses(P, together, progress.samples)
        rotation, translation, ok = differentiable_pnpl(P, together, start)
        pose = pose_loss(rotation, translation, truth.rotation, truth.translation)
        return {
            "loss": whole_loss(correspondence, pose, ok, gamma=1.0),
            "correspondence": correspondence.mean(),
            "pose": (pose * ok).sum() / ok.sum().clamp_min(1),
            "ok": ok.double().mean(),
        }

    def finish(self) -> None:
        """Nothing is left to choose."""

    def figures(self, together: Batch) -> dict[str, Tensor]:
        """Of seen elements with a true pair: whether it is the likeliest, or among the likeliest
        five; and the share of all mass that lies on true pairs."""
        P = self.network(together).probability
        pairs = _truth(together).pairs
        paired = pairs.any(dim=2)
        order = P.topk(min(_FEW, P.shape[2]), dim=2).indices
        hit = pairs.gather(2, order)[paired].double()
        loss = correspondence_loss(P, pairs, self.network.possible(together))
        return {
            "correspondence": loss.mean(),
            "top1": hit[:, 0].mean(),
            "top5": hit.amax(dim=1).mean(),
            "true_mass": ((P * pairs).sum(dim=(1, 2)) / P.sum(dim=(1, 2))).mean(),
        }


def make_task(name: str, source: SampleSource | None) -> PaperTask:
    """With fresh weights; on simulated roads if no source is given."""
    return PaperTask(name, source or PAPER_DRILLS)


def _truth(batch: Batch) -> BatchTruth:
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth
