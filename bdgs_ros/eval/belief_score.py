"""How often the belief of Gaussians was right: counts that can be pooled, and their ratios."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from bdgs_ros.eval.metric import Metric, ratio


@dataclass(frozen=True)
class BeliefScore:
    """
    Counts over Gaussians; add scores to pool runs.

    "Called dynamic" is a Gaussian that is not rendered (Eq. 11) or was deleted because of its
    belief; when each is judged says `bdgs_ros.eval.belief_ledger`.
    """

    true_positives: int = 0
    false_positives: int = 0
    false_negatives: int = 0
    true_negatives: int = 0
    thing_positives: int = 0
    """Of the true positives, those on things that no detector knows."""
    thing_negatives: int = 0
    """Of the false negatives, likewise."""
    statics: int = 0
    """Static at the end of the run, those deleted by belief included."""
    statics_removed: int = 0
    """Of these, deleted or not rendered."""
    restored: int = 0
    """Statics that were rendered once, then hidden, then seen: rendered again in time."""
    not_restored: int = 0
    settled: int = 0
    """Statics seen but never rendered before, such as what was just put down: shown in time."""
    not_settled: int = 0
    unresolved: int = 0
    """Of either kind: covered again, changed or over before the time was up; not counted."""

    def __add__(self, other: BeliefScore) -> BeliefScore:
        """Pool the counts of two runs."""
        names = [f.name for f in fields(self)]
        return BeliefScore(**{n: getattr(self, n) + getattr(other, n) for n in names})

    @classmethod
    def of(cls, counts: Mapping[str, Any]) -> BeliefScore:
        """Take the counts out of a mapping that has more; what is not there counts as zero."""
        return cls(**{f.name: int(counts.get(f.name) or 0) for f in fields(cls)})

    def counts(self) -> dict[str, int]:
        """Return every count by its name."""
        return asdict(self)

    @property
    def recall(self) -> float:
        """Share of the dynamic Gaussians that were called so; NaN if there is none."""
        return ratio(self.true_positives, self.true_positives + self.false_negatives)

    @property
    def precision(self) -> float:
        """Share of the Gaussians called dynamic that are; NaN where nothing is dynamic."""
        some = self.true_positives + self.false_negatives
        return ratio(
            self.true_positives, (self.true_positives + self.false_positives) * bool(some)
        )

    @property
    def unknown_recall(self) -> float:
        """Recall on things that no detector knows."""
        return ratio(self.thing_positives, self.thing_positives + self.thing_negatives)

    @property
    def false_removal(self) -> float:
        """Share of the statics that are gone from the render at the end of the run."""
        return ratio(self.statics_removed, self.statics)

    @property
    def restored_share(self) -> float:
        """Share of hidden statics that were rendered again in time after they were seen."""
        return ratio(self.restored, self.restored + self.not_restored)

    @property
    def settled_share(self) -> float:
        """Share of new statics that were rendered in time after they were seen."""
        return ratio(self.settled, self.settled + self.not_settled)

    def metrics(self) -> list[Metric]:
        """Return the ratios."""
        return [
            Metric('belief_precision', self.precision),
            Metric('belief_recall', self.recall),
            Metric('unknown_recall', self.unknown_recall),
            Metric('false_removal', 100 * self.false_removal, '%'),
            Metric('restored', 100 * self.restored_share, '%'),
            Metric('settled', 100 * self.settled_share, '%'),
        ]
