"""The twin against finite differences, dense algebra and known plants; the tuner on plants that its model can and cannot be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from two_pairs import AnotherCell, TwoPairs

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.settings import SensorSettings
from chargetune.battery.charging.tunables import Backoff, ResistanceRatio
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.battery.charging.verdict import score_episode
from chargetune.episode.lookup_table import LookupTable
from chargetune.learning import Safety, Twin, TwinTuner, Uncertain
from chargetune.learning.candidates import Proposal
from chargetune.learning.twin import twin as twin_module
from chargetune.learning.twin.ensemble import condition
from chargetune.learning.twin.laplace import NegativeLogPosterior
from chargetune.learning.twin_tuner import cautious
from charging_problems import changed, charging_problem

CELL = default_cell()
TABLES = ("R0_ohm", "R1_ohm", "C1_F")


def charge(noise=0.002, seed=1, **changes):
    return charging_problem(CELL, mismatch_seed=seed, voltage_noise_sd_V=noise, steps=120, **changes)


def twin_of(problem, **changes):
    return replace(ChargingTwin(problem).twin, **changes)


def test_sensitivities_are_those_of_finite_differences():
    twin = Twin(
        ecm_model(CELL), (
            Uncertain("R1_ohm", 0.3), Uncertain("capacity_Ah", 0.1, "offset"),
            Uncertain("soc", 0.02, "start"), Uncertain("voltage_V", 0.01, "bias"),
        ),
        {"voltage_V": 1e-3, "soc": 1e-3}, start_state(CELL, 0.3),
    )  # fmt: skip
    inputs = np.random.default_rng(0).uniform(-2, 5, (15, 1))
    m = 0.05 * np.random.default_rng(1).standard_normal(12)
    posterior = twin.fit([])
    slopes = replace(posterior, mode=m, root=np.eye(12)).predicted_sd(inputs) ** 2 - np.array([1e-6, 1e-6])
    differences = [(twin.predict(m + h, inputs) - twin.predict(m - h, inputs)) / 2e-5 for h in 1e-5 * np.eye(12)]
    np.testing.assert_allclose(slopes, np.sum(np.square(differences), axis=0), rtol=1e-4, atol=1e-9)


def test_several_episodes_and_several_unknowns_at_once_are_as_one_after_the_other():
    """Also more of them than go into one call, and episodes of different lengths."""
    problem = charge()
    twin = twin_of(problem)
    inputs = [np.random.default_rng(k).uniform(0, 5, (length, 1)) for k, length in enumerate((30, 60, 17))]
    unknowns = 0.1 * np.random.default_rng(9).standard_normal((19, 27))
    together = twin.predict_each(unknowns, inputs)
    assert [values.shape for values in together] == [(19, len(u), 2, 1) for u in inputs]
    for u, values in zip(inputs, together, strict=True):
        np.testing.assert_allclose(values, [twin.predict(m, u) for m in unknowns], rtol=0, atol=1e-12)
    for u, values in zip(inputs, twin.slopes_each(unknowns[0], inputs), strict=True):
        np.testing.assert_allclose(values, twin.slopes(unknowns[0], u), rtol=0, atol=1e-12)


@pytest.mark.parametrize("changes", [{}, {"plant_model": AnotherCell(CELL)}], ids=["the circuit", "another plant"])
def test_a_fit_along_the_way_of_another_ends_where_it_would_by_itself(changes, monkeypatch):
    """Within a small part of a standard deviation, and it is as wide; each search begins where the one before ended."""
    problem = charge(R0=ResistanceRatio(0.1, 4.0), **changes)
    twin = twin_of(problem)
    episodes = [run_charge(problem, np.full(9, ratio), k) for k, ratio in enumerate((2.5, 2.0, 1.7, 1.5))]
    alone, way = twin.fit(episodes), twin.fit(episodes[:3]).way
    begun, search = [], twin_module.least_squares
    monkeypatch.setattr(twin_module, "least_squares", lambda f, e, **how: (begun.append(e), search(f, e, **how))[1])
    along = twin.fit(episodes, way=way)
    np.testing.assert_allclose([twin.prior_factor @ e for e in begun[: len(way)]], way[: len(begun)], atol=1e-9)
    np.testing.assert_allclose(along.spread, alone.spread, rtol=0.02)
    away = np.linalg.solve(alone.root, along.mode - alone.mode)
    assert np.linalg.norm(away) < 0.3
    np.testing.assert_allclose(np.diag(along.covariance), np.diag(alone.covariance), rtol=0.05)


def test_plants_whose_drawing_was_begun_are_those_that_are_drawn_when_they_are_needed():
    problem = charge(R0=ResistanceRatio(0.1, 4.0))
    episode = run_charge(problem, np.full(9, 2.5))
    trials = [SimpleNamespace(number=0, theta=(2.5,) * 9, status="done", score=score_episode(problem, episode), episode=lambda: episode)]
    loop = ChargingTwin(problem)
    begun, needed = condition(loop, trials), condition(loop, trials)
    begun.draw(6, 1)
    drawn = begun.replayed(episode, 6, 1).episodes
    for one, other in zip(drawn, needed.replayed(episode, 6, 1).episodes, strict=True):
        np.testing.assert_array_equal(one.output_end, other.output_end)
    # Another seed has other plants.
    assert not np.array_equal(begun.replayed(episode, 6, 2).episodes[0].output_end, drawn[0].output_end)


def test_without_data_it_is_the_prior():
    twin = twin_of(charge())
    posterior = twin.fit([])
    assert np.all(posterior.mode == 0)
    steps = np.abs(np.subtract.outer(np.arange(9), np.arange(9)))
    np.testing.assert_allclose(posterior.covariance[:9, :9], 0.4**2 * 0.3**steps, atol=1e-12)
    draws = posterior.draw(4000, 0)
    np.testing.assert_allclose(np.cov(draws.T), posterior.covariance, atol=0.02)


@pytest.mark.usefixtures("virtual_machine")
def test_covariance_is_that_of_dense_algebra():
    problem = charge()
    twin = twin_of(problem)
    posterior = twin.fit([run_charge(problem)], discrepancy=False)
    inputs = run_charge(problem).input
    columns = [
        (twin.predict(posterior.mode + h, inputs) - twin.predict(posterior.mode - h, inputs)).ravel() / 2e-5 for h in 1e-5 * np.eye(27)
    ]
    jacobian = np.array(columns).T / 0.002
    prior = np.linalg.inv(twin.prior_factor @ twin.prior_factor.T)
    np.testing.assert_allclose(posterior.covariance, np.linalg.inv(jacobian.T @ jacobian + prior), rtol=2e-3, atol=1e-6)


def test_one_charge_tells_the_voltage_of_another():
    """90 % intervals of new noisy samples under another input cover 85 to 95 % of them (at half the current, 84 %)."""
    covered = []
    for seed in range(8):
        problem = charge(seed=seed)
        posterior = twin_of(problem).fit([run_charge(problem, seed=seed)])
        other = run_charge(changed(problem, current_max_A=5.0), seed=100 + seed)
        predicted = posterior.twin.predict(posterior.mode, other.input)[..., 0]
        measured = np.stack(other.signal("voltage_V"), axis=1)
        covered.append(np.abs(measured - predicted) < 1.645 * posterior.predicted_sd(other.input)[..., 0])
    assert 0.85 < np.mean(covered) < 0.95


def test_draws_do_not_depend_on_how_many_cores_there_are(monkeypatch):
    problem = charge(R0=ResistanceRatio())
    posterior = ChargingTwin(problem).twin.fit([run_charge(problem, problem.space.default)])
    drawn = posterior.draw(6, 3)
    monkeypatch.setattr("chargetune.runtime.threads.usable_cores", lambda: 1)
    np.testing.assert_array_equal(posterior.draw(6, 3), drawn)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("factor", [30.0, 100.0, 1e3, 1e4])
def test_a_draw_from_which_outputs_are_not_finite_is_halved(factor):
    problem = charge(R0=ResistanceRatio())
    posterior = ChargingTwin(problem).twin.fit([run_charge(problem, problem.space.default)])
    assert np.all(np.isfinite(replace(posterior, root=factor * posterior.root).draw(8, 0)))


def test_missing_samples_and_short_traces_are_taken_as_they_are():
    problem = charge()
    episode = run_charge(problem)
    holes = episode.output_end.copy()
    holes[::3, 0] = np.nan
    short = replace(episode, output_end=holes).cut(60, episode.ending, "")
    whole, part = (twin_of(problem).fit([e]) for e in (episode, short))
    assert np.all(np.isfinite(part.mode))
    assert np.trace(part.covariance) > np.trace(whole.covariance)


@pytest.mark.usefixtures("virtual_machine")
def test_where_the_record_of_the_input_ends_nothing_is_predicted_and_nothing_is_lost():
    problem = charge()
    episode = run_charge(problem, problem.space.default, 0)
    lost = replace(episode, input=episode.input.copy(), output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
    for values in (lost.input, lost.output_start, lost.output_end):
        values[90:] = np.nan
    whole, half = (twin_of(problem).fit([e], discrepancy=False) for e in (lost, episode.cut(90, episode.ending, "")))
    np.testing.assert_allclose(whole.mode, half.mode, atol=1e-4)
    np.testing.assert_allclose(whole.draw(4, 0), half.draw(4, 0), atol=1e-3)


def test_capacity_start_and_a_constant_error_of_the_voltage_come_back():
    """What a real cell does not tell: the charge that it holds, where it starts, an OCV that is off."""
    loop = ChargingTwin(charge(seed=2), capacity_spread=0.05, soc_spread=0.02, ocv_spread_V=0.005)
    true = np.append(np.zeros(27), [-0.03, 0.015, 0.004])
    theta = loop.problem.space.default
    episode = loop.simulate([(theta, true, None)])[0]
    at_rest = loop.simulate([(theta, np.append(true[:-1], 0.0), None)])[0]
    np.testing.assert_allclose(episode.signal("voltage_V")[1] - at_rest.signal("voltage_V")[1], 0.004, atol=1e-12)
    posterior = loop.twin.fit([episode])
    off = np.abs(posterior.mode - true)[-3:] / np.sqrt(np.diag(posterior.covariance))[-3:]
    assert np.all(off < 3)
    assert np.all(np.sqrt(np.diag(posterior.covariance))[-3:] < [0.02, 0.01, 0.005])


def test_the_controller_reads_what_the_twin_cannot_represent():
    """A cell that is half a kelvin warmer than its model, held at a limit of temperature, against a sensor that is off by as much."""
    warm = replace(CELL, thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.05, activation_J_mol=15e3))
    problem = charging_problem(warm, mismatch_seed=1, steps=120, temperature_max_K=305.0, R0=ResistanceRatio())
    loop = ChargingTwin(problem)

    lookup_table = LookupTable.over(loop.features, list(loop.twin.noise_sd))
    warmer = SimpleNamespace(table=np.tile([[0.5 if name == "temperature_K" else 0.0] for name in lookup_table.outputs], lookup_table.size))
    theta = problem.space.default
    predicted = loop.simulate([(theta, np.zeros(27), warmer)])[0]
    # The circuit of the twin is the controller's own: the plant without a mismatch.
    biased = changed(problem, plant=AnotherCell(problem.controller_cell), temperature_bias_K=0.5)
    measured = run_charge(biased, theta)
    for name in ("temperature_K", "voltage_V"):
        np.testing.assert_allclose(predicted.signal(name)[1], measured.signal(name)[1], rtol=0, atol=1e-6)
    assert np.max(measured.signal("temperature_K")[1]) == pytest.approx(305.0, abs=0.1)
    without = loop.simulate([(theta, np.zeros(27), None)])[0]
    assert np.max(np.abs(without.input - predicted.input)) > 0.1


def test_what_the_model_cannot_represent_is_a_discrepancy():
    problem = charge(noise=0.0005)
    episode = run_charge(problem)
    wrong = episode.output_end.copy()
    wrong[:, 0] += 0.01 * np.sin(np.arange(len(episode)) / 3)
    posterior = twin_of(problem).fit([replace(episode, output_end=wrong)])
    assert posterior.discrepancy_sd[0] > 0.003
    assert twin_of(problem).fit([episode]).discrepancy_sd[0] < 0.001


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Uncertain("R0_ohm", 0.0), "sd of R0_ohm = 0.0"),
        (lambda: Uncertain("R0_ohm", 0.1, smooth=1.0), "smooth of R0_ohm = 1.0"),
        (lambda: Uncertain("R0_ohm", 0.1, "ratio"), "kind of R0_ohm = 'ratio'"),
        (lambda: Twin(ecm_model(CELL), (Uncertain("R9", 0.1),), {"voltage_V": 1e-3}), "unknown factor 'R9'"),
        (lambda: Twin(ecm_model(CELL), (Uncertain("soc", 0.1, "bias"),), {"voltage_V": 1e-3}), "unknown bias 'soc', allowed are voltage_V"),
        (lambda: Twin(ecm_model(CELL), (), {"voltage_V": 1e-3}), "at least one"),
        (lambda: Twin(ecm_model(CELL), (Uncertain("R0_ohm", 0.1),), {"current": 1e-3}), "noise_sd names ['current']"),
        (lambda: Twin(ecm_model(CELL), (Uncertain("R0_ohm", 0.1),), {"voltage_V": 0.0}), "finite numbers > 0"),
    ],
)
def test_nonsense_is_refused_by_name(make, said):
    with pytest.raises(ValueError, match="twin") as caught:
        make()
    assert said in str(caught.value)


def test_three_trials_are_enough():
    """Nine R0 nodes, resistances wrong by up to half, 2 mV noise: the plant's true excess and t95 beside the attainable ones."""
    noisy = charging_problem(CELL, mismatch_seed=1, R0=ResistanceRatio(0.1, 4.0), voltage_noise_sd_V=0.002, verdict_samples=5)
    exact = changed(noisy, sensors=SensorSettings())
    tuner, trials = TwinTuner(ChargingTwin(noisy)), []
    for number in range(3):
        theta = tuner.ask(noisy.space, trials)[0]
        score, episode, _ = evaluate(noisy, theta, number)
        trials.append(SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, episode=lambda e=episode: e))
    np.testing.assert_array_equal(trials[0].theta, noisy.space.default)
    metrics = score_episode(exact, run_charge(exact, trials[-1].theta)).metrics
    assert metrics["overshoot_mV"] <= 1.0
    # 36.7 min is what 4000 evaluations of CMA-ES reach on this plant.
    assert metrics["t95_min"] <= 1.05 * 36.7
    np.testing.assert_array_equal(tuner.ask(noisy.space, trials[:2])[0], trials[2].theta)
    assert [tuner.best(noisy.space, trials[:n]) for n in (0, 3)] == [None, 2]


def test_no_envelope_step_leads_away_from_the_best_objective():
    """Here a step that takes some sd back moves backoff from 100 to 90 % SOC, and costs minutes; polished it stays there (39.8)."""
    backoff = Backoff(nodes=11, lower_V=-0.3, upper_V=0.3)
    noisy = charging_problem(CELL, mismatch_seed=16, backoff=backoff, voltage_noise_sd_V=0.002, verdict_samples=5, charge_time_to_soc=0.95)
    second, trials = [0.03, 0.03, 0.06, 0.135, 0.09, 0.03, 0.027, -0.096, -0.044, 0.05, 0.023], []
    for number, theta in enumerate((noisy.space.default, np.array(second))):
        score, episode, _ = evaluate(noisy, theta, number)
        trials.append(SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, episode=lambda e=episode: e))
    exact = changed(noisy, sensors=SensorSettings())
    metrics = score_episode(exact, run_charge(exact, TwinTuner(ChargingTwin(noisy)).ask(noisy.space, trials)[0])).metrics
    assert metrics["overshoot_mV"] <= 1.0
    # 37.1 min is what the third and fourth trials of a study reach with 0.6 mV over.
    assert metrics["t95_min"] <= 1.03 * 37.1


def test_what_is_taken_back_makes_it_likelier_that_the_limits_are_kept():
    problem = charge(R0=ResistanceRatio(0.1, 4.0))
    theta, trials = problem.space.default, []
    for number in range(2):
        score, episode, _ = evaluate(problem, theta * (1.0 + number), number)
        trials.append(
            SimpleNamespace(number=number, theta=tuple(theta * (1.0 + number)), status="done", score=score, episode=lambda e=episode: e)
        )
    tuner = TwinTuner(ChargingTwin(problem))
    ensemble = condition(tuner.loop, trials)
    chances = [predicted.probability() for _, predicted in cautious(Proposal(tuner.loop, problem.space, ensemble, trials, 3), theta)]
    assert ensemble.predict(theta, 64, 3).probability() < 0.1
    assert min(chances) >= 0.5
    assert np.mean(chances) > 0.8


def test_where_nothing_can_be_taken_back_it_is_not_and_the_likeliest_comes_first():
    """The plant overshoots by 60 mV, and an R1 within 1 % cannot change that."""
    problem = charge(R1=ResistanceRatio(0.99, 1.01))
    theta, trials = problem.space.default, []
    for number in range(2):
        score, episode, _ = evaluate(problem, theta, number)
        trials.append(SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, episode=lambda e=episode: e))
    tuner = TwinTuner(ChargingTwin(problem))
    found = cautious(Proposal(tuner.loop, problem.space, condition(tuner.loop, trials), trials, 3), theta)
    chances = [predicted.probability() for _, predicted in found]
    assert chances[0] < 0.5
    assert chances == sorted(chances, reverse=True)
    assert any(np.array_equal(theta, other) for other, _ in found)


def test_without_a_trace_the_design_is_theta_0_and_sobol():
    problem = charge(R0=ResistanceRatio())
    tuner = TwinTuner(ChargingTwin(problem))
    first = tuner.ask(problem.space, [], 3)
    np.testing.assert_array_equal(first[0], problem.space.default)
    lost = [SimpleNamespace(number=0, theta=tuple(first[0]), status="failed", score=None, episode=None)]
    np.testing.assert_array_equal(tuner.ask(problem.space, lost)[0], first[1])


def test_beside_a_running_trial_another_theta_is_proposed():
    problem = charge(R0=ResistanceRatio())
    tuner = TwinTuner(ChargingTwin(problem), pool=8, steps=2, iterations=3)
    score, episode, _ = evaluate(problem, problem.space.default, 0)
    trials = [SimpleNamespace(number=0, theta=tuple(problem.space.default), status="done", score=score, episode=lambda: episode)]
    expected = tuner.ask(problem.space, trials)[0]
    for number in (1, 2):
        trials.append(SimpleNamespace(number=number, theta=tuple(expected), status="running", score=None, episode=None))
        beside = tuner.ask(problem.space, trials)
        assert np.all(problem.space.validate(beside[0]) == beside[0])
        apart = problem.space.to_unit(np.array([t.theta for t in trials])) - problem.space.to_unit(beside)
        assert np.abs(apart).max(axis=1).min() > 1e-4
        np.testing.assert_array_equal(tuner.ask(problem.space, trials), beside)
        expected = beside[0]


def test_a_safe_twin_takes_nothing_from_a_running_trial():
    problem = charge(R0=ResistanceRatio(0.1, 4.0))
    tuner = TwinTuner(ChargingTwin(problem), safety=Safety())
    first = tuner.ask(problem.space, [])
    running = [SimpleNamespace(number=0, theta=tuple(first[0]), status="running", score=None, episode=None)]
    np.testing.assert_array_equal(tuner.ask(problem.space, running), first)


def test_a_posterior_is_that_of_the_spread_that_it_states():
    """Mode, curvature and sections by the misfit with ``Posterior.spread``, on a plant that the twin cannot be."""
    problem = charge(plant=TwoPairs(CELL), R0=ResistanceRatio(0.1, 4.0))
    episodes = [run_charge(problem, np.full(9, level), k) for k, level in enumerate((4.0, 2.0))]
    twin = twin_of(problem)
    posterior = twin.fit(episodes)
    misfit = NegativeLogPosterior(twin, [(e.input, twin.measured(e)) for e in episodes], posterior.spread)
    slopes = misfit.slopes(np.linalg.solve(twin.prior_factor, posterior.mode))
    stated = twin.prior_factor @ np.linalg.inv(slopes.T @ slopes) @ twin.prior_factor.T
    np.testing.assert_allclose(posterior.covariance, stated, rtol=1e-5, atol=1e-9)


def test_only_what_was_not_measured_has_no_verdict():
    problem = charge()
    loop, episode = ChargingTwin(problem), run_charge(problem, problem.space.default, 0)
    holed = replace(episode, output_end=np.full_like(episode.output_end, np.nan))
    assert loop.score(holed) is None
    with pytest.raises(ValueError, match="unknown output"):
        loop.score(replace(episode, output_names=tuple(f"other {name}" for name in episode.output_names)))
