"""Curves that Split&Splat (Monchieri et al.) prints, to lay beside our own sweeps: its figures, nothing added."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Curve:
    """A figure of the paper over one parameter."""

    parameter: str
    metric: str
    """The figure of ours (flows/measures.py) that it is to be laid beside."""
    source: str
    label: str
    """What the figures are of."""
    percent: tuple[tuple[float, float], ...]
    """(value of the parameter, figure in per cent), by rising value."""

    def points(self) -> tuple[list[float], list[float]]:
        """Values of the parameter, and the figures as fractions 0..1."""
        return [x for x, _ in self.percent], [y / 100 for _, y in self.percent]


_TAU_DEPTH = ("split.visibility.tau_depth", "Table 4", "paper, ScanNet 0062_00")
"""Of the labelled points, in metres; at 0.1 and 0.001 the paper prints a higher mAcc(50) than mAcc(25)."""

CURVES = (
    Curve(_TAU_DEPTH[0], "split.miou", *_TAU_DEPTH[1:], ((0.001, 51.98), (0.02, 63.98), (0.1, 62.33))),
    Curve(_TAU_DEPTH[0], "split.macc25", *_TAU_DEPTH[1:], ((0.001, 54.17), (0.02, 100.00), (0.1, 66.67))),
    Curve(_TAU_DEPTH[0], "split.macc50", *_TAU_DEPTH[1:], ((0.001, 70.83), (0.02, 70.83), (0.1, 95.83))),
    Curve(  # "average percentage of instances with label l"
        "semantics.query.tau_corr",
        "query.matched_share",
        "Table 6",
        "paper, LERF",
        ((0.01, 7.69), (0.02, 12.24), (0.025, 15.67), (0.05, 39.24), (0.075, 67.53), (0.1, 86.23), (0.2, 100.0)),
    ),
)


def curve(parameter: str, metric: str) -> Curve | None:
    """The paper's curve of a figure over a parameter, where it prints one."""
    return next((c for c in CURVES if (c.parameter, c.metric) == (parameter, metric)), None)
