"""What was found about the set-up: a number, how sure it is, what it looks like, how to mend it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from pamctl.diagnose.setup.suspects import Kind, label_number


@dataclass(frozen=True)
class SetupFinding:
    """One number of the set-up that is not what plant file or record say."""

    kind: Kind
    number: str
    """A number of the plant file, or a column of the record."""
    value: float
    """What it is: a plant's number in its unit; for a column the offset, delay or factor."""
    ci90: tuple[float, float]
    unit: str
    block: str
    """The block that shows it best."""
    gain: float
    """Held-out RMS without the correction over that with it, in this block."""
    residual_over_floor: float
    """What is left of that block with the correction, over its floor."""
    cannot_be_told_from: tuple[str, ...]
    """Effects of the catalogue, and other numbers, that explain these data as well."""
    how_to_mend: str
    text: str
    """The finding in words, without the block and the gain."""
    said: float | None = None
    """What the plant file says; None for a column."""
    by_record: Mapping[str, float] = field(default_factory=dict)
    """The value in each record, where it differs between records."""
    is_corrected: bool = True
    """The figures of the diagnosis rest on the corrected set-up."""

    @property
    def label(self) -> str:
        """What is wrong, in a few words."""
        return label_number(self.kind, self.number)

    def beside(self, others: Sequence[str]) -> SetupFinding:
        """Return the finding with more that it cannot be told from."""
        known = dict.fromkeys((*self.cannot_be_told_from, *others))
        return replace(self, cannot_be_told_from=tuple(known))

    def as_dict(self) -> dict[str, object]:
        """Return what the document holds."""
        return {
            "kind": self.kind,
            "number": self.number,
            "value": self.value,
            "ci90": [*self.ci90],
            "unit": self.unit,
            "said": self.said,
            "by_record": dict(self.by_record),
            "block": self.block,
            "gain": self.gain,
            "residual_over_floor": self.residual_over_floor,
            "cannot_be_told_from": [*self.cannot_be_told_from],
            "how_to_mend": self.how_to_mend,
            "text": self.text,
            "is_corrected": self.is_corrected,
        }
