"""Settings of the twin and of its search, each with the reason for its value."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["TwinSettings"]


@dataclass(frozen=True)
class TwinSettings:
    """Numbers of the twin, its discrepancy, its ensemble and the search for theta; an ablation is another argument.

    traces
        Newest episodes that are learnt from. Each holds some hundred samples: older ones add time and hardly information.
    bins
        Stretches of an episode over which residuals are averaged. What a model cannot represent changes slowly.
    correlated_bins
        Neighbouring bins that err together, so that as many count as one.
    length_scales, length_scale_sd
        Prior medians of the discrepancy's length scales, as shares of each feature's range, and the sd of their logarithms. The first
        feature is the one along which the plant moves (a state of charge): its scale is short.
    of_episode
        Prior median of the variance of an episode's own part of the discrepancy, to that of the common one; the sd of its logarithm is 1.
        0: there is none, which is right where all episodes begin alike.
    scale_sd
        Prior sd of the logarithm of the discrepancy's scale: before a prediction was checked the stated sd may be wrong by e.
    scale_share
        Share of its distribution that the scale of an ensemble is not below: one sd above the middle. A mean over all scales would
        hide that where the stated sd is wrong, every window of every plant is wrong at once.
    plants
        Members of an ensemble. The standard error of a probability of 0.95 is 0.027.
    judges
        Fresh members that judge a theta before it is proposed: of 64 four or more refused by chance what 97 % of 400 allow.
    standardised_error_max
        Error of the newest prediction, in stated sd, from which the twin is none. Chance exceeds 3.5 once in 2000 times.
    near
        A window that so many sd keep below its limit does not count among those that hold together.
    aim
        Share of a limit's tolerance that the upper side of the prediction may use; the rest is for what few plants do not show.
    rounds
        Times that the program is solved, each with margins from the theta found before. Each halves what the first margin is wrong by.
    iterations, gain
        Of the search in one round, and the share of the objective that an iteration has to win. A measured time is worth no more.
    proximal
        Share of the objective that moving one entry of theta over its whole range has to win: what is not needed stays as it was tried.
    pool
        Sobol points from which a search may begin beside the thetas that were tried: from theta_0 alone a plant may be a plateau.
    steps_back
        Shares of the way from a safe theta to one that is not, tried in this order.
    """

    traces: int = 4
    bins: int = 40
    correlated_bins: float = 4.0
    length_scales: tuple[float, ...] = (0.15, 0.5, 0.5)
    length_scale_sd: float = 0.5
    of_episode: float = 0.0
    scale_sd: float = 1.0
    scale_share: float = 0.84
    plants: int = 64
    judges: int = 128
    standardised_error_max: float = 3.5
    near: float = 3.0
    aim: float = 0.75
    rounds: int = 6
    iterations: int = 15
    gain: float = 1e-3
    proximal: float = 1e-3
    pool: int = 32
    steps_back: tuple[float, ...] = (0.8, 0.5, 0.25)

    def __post_init__(self) -> None:
        for name in ("traces", "bins", "plants", "judges", "rounds", "iterations", "pool"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"twin settings: {name} = {value!r}, allowed is an integer >= 1")
        for name in ("correlated_bins", "length_scale_sd", "scale_sd", "standardised_error_max", "near", "gain"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
                raise ValueError(f"twin settings: {name} = {value!r}, allowed is a number > 0")
        if isinstance(self.of_episode, bool) or not isinstance(self.of_episode, (int, float)) or not 0 <= self.of_episode < float("inf"):
            raise ValueError(f"twin settings: of_episode = {self.of_episode!r}, allowed is a number >= 0")
        for name in ("scale_share", "aim", "proximal"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
                raise ValueError(f"twin settings: {name} = {value!r}, allowed is [0, 1]")
        for name, most in (("length_scales", float("inf")), ("steps_back", 1.0)):
            values = getattr(self, name)
            if not all(isinstance(v, (int, float)) and 0 < v < most for v in values):
                raise ValueError(f"twin settings: {name} = {values!r}, allowed are numbers in (0, {most:g})")
