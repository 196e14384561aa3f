"""What a diagnosis says: findings in words, the worst first."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

SEVERITIES = ("fault", "warning", "note")
"""From worst to mildest: depth is wrong; depth is worse than it could be; worth knowing, nothing is broken."""

WARNING_DEG, FAULT_DEG = 0.5, 3.0
"""Errors of normals from which a finding is a warning, and a fault."""

COST_DEG = {"fault": FAULT_DEG, "warning": WARNING_DEG, "note": 0.0}
"""The least error of normals that a severity stands for: of several frames the sum tells which finding costs most."""


def by_cost(cost_deg: float) -> str:
    """The severity of an error of normals."""
    return "fault" if cost_deg >= FAULT_DEG else "warning" if cost_deg >= WARNING_DEG else "note"


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Args:
        name: stable identifier, such as "channels_swapped".
        message: what it is, with its figure, and what to do.
        severity: "note", "warning" or "fault".
        value: the figure, in the unit that the message names.
    Raises:
        ValueError: an unknown severity.
    Example:
        >>> Finding("noise", "noise is 4.0 times that at calibration", "warning", 4.0).severity
        'warning'
    """

    name: str
    message: str
    severity: str
    value: float

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity: expected one of {', '.join(SEVERITIES)}, got {self.severity!r}")

    def __str__(self) -> str:
        return f"{self.severity}: {self.message} [{self.name}]"


@dataclass(frozen=True)
class Diagnosis:
    """All findings, the worst first.

    Args:
        findings: sorted when made; of several with one name the worst is kept.
    Example:
        >>> print(Diagnosis((Finding("no_contact", "no contact", "note", 0.0),)))
        ok
        note: no contact [no_contact]
    """

    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "Diagnosis":
        """Sort by severity; of several findings with one name keep the first of the worst."""
        kept: dict[str, Finding] = {}
        for finding in sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)):
            kept.setdefault(finding.name, finding)
        return cls(tuple(kept.values()))

    @property
    def ok(self) -> bool:
        """Neither a fault nor a warning."""
        return all(finding.severity == "note" for finding in self.findings)

    @property
    def names(self) -> tuple[str, ...]:
        """The findings' names, the worst first."""
        return tuple(finding.name for finding in self.findings)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.findings)

    def __len__(self) -> int:
        return len(self.findings)

    def __str__(self) -> str:
        return "\n".join((["ok"] if self.ok else []) + [str(finding) for finding in self.findings])
