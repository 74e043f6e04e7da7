"""Ways of charging on drawn plants, against what is known of them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from chargetune.battery.baselines.comparison import CCCV, ConstantBackoffs, smallest_that_keep
from chargetune.battery.baselines.range_comparison import ORACLE, STEPS, RangeRow, compare_range, range_row_names
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.observers import OffsetFree
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.tunables import Backoff
from chargetune.battery.charging.verdict import score_episode
from charging_problems import charging_problem

CELL = default_cell()
USE = ChargingRangeSettings(soc_start=(0.3, 0.5), resistance=0.03, growth=0.05)


@pytest.fixture(scope="module")
def rows():
    problem = replace(charging_problem(CELL, mismatch_seed=None, horizon=3, steps=240, backoff=Backoff(nodes=2)), range=USE)
    found = {row.name: row for row in compare_range(problem, [0.06, 0.06], draws=6)}
    assert sorted(found) == sorted(range_row_names(problem, [0.06, 0.06]))
    return found


def test_what_knows_each_plant_keeps_its_limits_and_is_the_fastest(rows):
    oracle, knowing = rows[ORACLE], rows["MPC that knows each plant"]
    assert oracle.violations == knowing.violations == 0
    # Two ways to the same: the largest current that keeps the voltage, and a controller with the drawn cell for a model.
    assert oracle.mean("t80_min") == pytest.approx(knowing.mean("t80_min"), rel=5e-3)
    assert abs(knowing.worst_excess("voltage_max_V")) < 5e-4
    for name, row in rows.items():
        assert len(row.scores) == 6
        if not row.breaks_limit:
            assert row.mean("t80_min") >= oracle.mean("t80_min") * (1 - 1e-4), name


def test_the_controller_without_a_margin_breaks_the_limit_and_the_smallest_backoff_keeps_it_just(rows):
    assert rows["nominal MPC"].violations > 0
    best = rows["best constant backoff"]
    assert best.violations == 0
    # The search ends within 0.5 mV of the value where it breaks, which is the tolerance beyond the limit.
    assert -6e-4 <= best.worst_excess("voltage_max_V") <= 5e-4
    assert best.setting.endswith(" mV")
    assert rows["tuned"].violations == 0
    assert rows["tuned"].mean("t80_min") > best.mean("t80_min")
    # CC-CV reads the voltage of each plant: without another limit its largest rate keeps it.
    assert rows[CCCV].setting == "6 A"
    assert rows[CCCV].mean("t80_min") == pytest.approx(rows[ORACLE].mean("t80_min"), rel=1e-9)


def test_the_fastest_rate_is_that_of_the_hottest_plant():
    warm = replace(CELL, thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05))
    problem = charging_problem(warm, mismatch_seed=None, horizon=3, steps=150, temperature_max_K=306.0, backoff=Backoff(nodes=2))
    problem = replace(problem, range=ChargingRangeSettings(soc_start=(0.3, 0.5), resistance=0.2))
    row, steps = compare_range(problem, rows=[CCCV, STEPS], draws=4)
    rate = float(row.setting.removesuffix(" A"))
    assert row.violations == steps.violations == 0
    assert 0.3 < rate < 5.9
    # The five currents fall to a third, so the first one may be larger where heat takes time to gather.
    first, last = (float(text) for text in steps.setting.removesuffix(" A").split(" to "))
    assert first > rate
    assert last == pytest.approx(first / 3, rel=0.01)
    for one in (row, steps):
        assert -1.5 < one.worst_excess("temperature_max_K") <= 0.1


def test_draws_are_the_same_for_every_row_and_depend_on_the_seed():
    problem = replace(charging_problem(CELL, mismatch_seed=None, horizon=3, steps=240, backoff=Backoff(nodes=2)), range=USE)

    def tuned(seed):
        return next(compare_range(problem, [0.1, 0.1], rows=["nominal MPC"], draws=3, seed=seed))

    assert tuned(0) == tuned(0) != tuned(1)


def test_figures_of_a_row_by_hand():
    problem = charging_problem(CELL, mismatch_seed=1, horizon=3, steps=150)
    score = score_episode(problem, run_charge(problem))
    quick = replace(score, metrics={**score.metrics, "t80_min": 10.0}, excess={**score.excess, "voltage_max_V": -0.001})
    slow = replace(quick, metrics={**score.metrics, "t80_min": 14.0}, excess={**score.excess, "voltage_max_V": 0.002})
    row = RangeRow("a", (quick, slow))
    assert (row.violations, row.mean("t80_min"), row.worst_excess("voltage_max_V")) == (1, 12.0, 0.002)
    # A plant that never got there is in no mean, and so there is none.
    ended = RangeRow("b", (quick, slow, None))
    assert (ended.violations, ended.mean("t80_min")) == (2, None)


@dataclass
class Run:
    """Each limit is kept where its value is at least its edge, and all together where their sum is at most ``most``."""

    values: list[float]
    edges: tuple[float, ...]
    most: float = 99.0

    def breaks(self, limit):
        return self.values[int(limit)] < self.edges[int(limit)]

    @property
    def breaks_limit(self):
        return any(map(self.breaks, "01"[: len(self.edges)])) or self.most < sum(self.values) < 5.3


@pytest.mark.parametrize(
    ("edges", "most", "expected"),
    [
        ((-1.0,), 99.0, [0.0]),
        ((0.1,), 99.0, [0.1]),
        ((0.9,), 99.0, [0.3]),
        ((0.1, 2.0), 99.0, [0.1, 2.0]),
        ((-1.0, 2.0), 99.0, [0.0, 2.0]),
        ((0.1, -1.0), 99.0, [0.1, 0.0]),
        ((0.9, 1.0), 99.0, [0.3, 5.0]),
        ((0.1, 2.0), 2.05, [0.3, 5.0]),
    ],
)
def test_the_smallest_values_are_found(edges, most, expected):
    largest, tolerances = [0.3, 5.0][: len(edges)], [5e-4, 0.05][: len(edges)]
    found = smallest_that_keep(lambda values: Run(list(values), edges, most), "01"[: len(edges)], largest, tolerances).values
    assert all(abs(one - wanted) <= tolerance for one, wanted, tolerance in zip(found, expected, tolerances, strict=True))


def test_each_limit_that_the_controller_keeps_has_its_own_backoff():
    """A cell whose temperature is limited as well: the smallest margins to both, in a table with both units."""
    warm = replace(CELL, thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05))
    problem = charging_problem(warm, mismatch_seed=1, horizon=3, steps=150, temperature_max_K=306.0, kind="offset_free")
    backoffs = ConstantBackoffs(replace(problem, estimator=replace(problem.estimator, offset_free=OffsetFree(backoff_sd=0.0))))
    assert backoffs.of == ("voltage", "temperature")
    assert backoffs.setting([0.0104, 0.301]) == "voltage 10.4 mV, temperature 0.30 K"
    assert backoffs.problem.space.entries == ("backoff_V[0]", "backoff_V[1]", "temperature_backoff_K")
    assert backoffs.theta([0.01, 0.3]) == [0.01, 0.01, 0.3]
    (row,) = compare_range(replace(backoffs.plain, range=USE), rows=["best constant backoff"], draws=2)
    assert row.violations == 0
    assert -1e-3 <= row.worst_excess("voltage_max_V") <= 5e-4
    assert -0.15 <= row.worst_excess("temperature_max_K") <= 0.05


def test_without_a_range_nothing_is_drawn():
    with pytest.raises(ValueError, match="range = None"):
        next(compare_range(charging_problem(CELL, backoff=Backoff(nodes=2)), np.zeros(2).tolist(), draws=2))
