"""Certificates: a controller with a known violation rate, draws, and what the second arithmetic makes of tampered ones."""

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.certification.certificate import charge_seed, figures, run_charges, write_certificate
from chargetune.battery.certification.default_range import default_range
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.tunables import Backoff
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.episode.episode import Ending
from chargetune.study.evaluation import trial_seed
from chargetune.verify import upper_bound, verify
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()
NONE = ChargingRangeSettings()
MODEST = ChargingRangeSettings(soc_start=(0.4, 0.6), resistance=0.002, capacitance_by_node=0.05, capacity=0.02, fade=0.05)
ONLY_START = ChargingRangeSettings(soc_start=(0.5, 0.7))
THETA = (0.0, 0.0)


def forced(**changes):
    """A controller that has to charge with 4 A for 6 intervals: it breaks the limit where the charge starts late."""
    settings = {"mismatch_seed": None, "backoff": Backoff(nodes=2), "steps": 6, "soc_start": 0.6, "current_min_A": 4.0}
    return charging_problem(CELL, **(settings | changes))


def charges(problem, settings, episodes, seed=0):
    problem = replace(problem, range=settings)
    return [charge for portion in run_charges(problem, THETA, seed=seed, episodes=episodes) for charge in portion]


def start(charge):
    return charge.values["soc_start"][0]


def threshold():
    """The SOC at the start from which on the limit is broken, by bisection on single episodes."""
    low, high = 0.5, 0.7
    for _ in range(30):
        middle = (low + high) / 2
        score, _, _ = evaluate(forced(soc_start=middle), np.zeros(2), 0)
        low, high = (low, middle) if not score.feasible else (middle, high)
    return high


def test_the_bound_on_a_controller_with_a_known_violation_rate():
    """The start is uniform in 0.5..0.7, so the rate is known; the bound has to hold in 95 % of the repetitions."""
    edge = threshold()
    rate = (0.7 - edge) / 0.2
    assert 0.1 < rate < 0.9
    tolerances = {limit.name: limit.tolerance for limit in forced().limits_by_name.values()}
    everything = charges(forced(), ONLY_START, 300)
    counted = np.array([not charge.score.feasible for charge in everything])
    # Each episode violates exactly where the start is beyond the threshold.
    np.testing.assert_array_equal(counted, [start(charge) >= edge for charge in everything])
    assert abs(counted.mean() - rate) < 4 * math.sqrt(rate * (1 - rate) / counted.size)
    held = []
    for part in range(15):
        found = figures(everything[20 * part : 20 * part + 20], tolerances, 0.95)
        assert found["violations"] == counted[20 * part : 20 * part + 20].sum()
        held.append(found["violation_probability_upper"] >= rate)
    # 15 repetitions with at least 0.95 each: fewer than 12 have a probability below 0.006.
    assert sum(held) >= 12


def test_a_planted_random_violation_with_a_known_probability():
    """One episode, broken at random in a share p of the repetitions: the bound covers p as often as it says."""
    (kept,) = charges(forced(soc_start=0.5), ChargingRangeSettings(soc_start=(0.499, 0.501)), 1)
    assert kept.score.feasible
    broken = replace(kept, score=replace(kept.score, excess={**kept.score.excess, "voltage_max_V": 0.01}))
    draw, tolerances = np.random.default_rng(0), kept.score.tolerance
    for p in (0.02, 0.3):
        sample = draw.uniform(size=(400, 50)) < p
        held = [figures([broken if b else kept for b in row], tolerances, 0.9)["violation_probability_upper"] >= p for row in sample]
        # 0.9 less three standard deviations of 400 repetitions.
        assert np.mean(held) >= 0.9 - 3 * math.sqrt(0.09 / 400)


def test_an_episode_that_does_not_come_to_its_end_counts_as_a_violation():
    (kept,) = charges(forced(soc_start=0.5), ChargingRangeSettings(soc_start=(0.499, 0.501)), 1)
    ended = replace(kept, score=None, episode=kept.episode.cut(3, Ending.SOLVER, "no finite input"))
    found = figures([kept, ended], kept.score.tolerance, 0.95)
    assert (found["not_completed"], found["violations"], found["voltage_max_V.violations"]) == (1, 1, 0)
    assert found["t80_min.worst"] is None


def test_quantiles_by_hand():
    (one,) = charges(forced(soc_start=0.5), ChargingRangeSettings(soc_start=(0.499, 0.501)), 1)
    made = [replace(one, score=replace(one.score, metrics={**one.score.metrics, "t80_min": float(k)})) for k in range(1, 20)]
    never = replace(one, score=replace(one.score, metrics={**one.score.metrics, "t80_min": None}))
    found = figures([*made, never], one.score.tolerance, 0.95)
    assert [found[f"t80_min.{q}"] for q in ("q05", "q50", "q95", "worst")] == [1.0, 10.0, 19.0, None]


def test_draws_are_within_the_default_range_and_depend_on_seed_and_index_alone():
    problem = replace(forced(), range=default_range(forced()))
    use = ChargingRange(problem)
    drawn = [use.draw(1, charge_seed(3, index))[0] for index in range(500)]
    assert use.draw(1, charge_seed(3, 7))[0].values == drawn[7].values != use.draw(1, charge_seed(4, 7))[0].values
    starts = np.array([use.values(d)["soc_start"][0] for d in drawn])
    age = np.array([d.values["age"][0] for d in drawn])
    parameters = [dict(d.plant.model.parameters) for d in drawn]
    nominal = dict(forced().cell.__dict__)
    r0 = np.array([p["R0_ohm"] for p in parameters]) / nominal["R0_ohm"]
    capacity = np.array([float(np.squeeze(p["capacity_Ah"])) for p in parameters]) / nominal["capacity_Ah"]
    assert starts.min() >= 0.57
    assert starts.max() <= 0.63
    assert np.ptp(starts) > 0.05
    # Without the age, each node of R0 is (1 +- 0.05)(1 +- 0.02) and the capacity 1 +- 0.02.
    assert np.abs(r0 / (1 + 0.1 * age[:, None]) - 1).max() <= 1.05 * 1.02 - 1
    assert np.abs(capacity / (1 - 0.05 * age) - 1).max() <= 0.02
    assert np.corrcoef(r0[:, 0], age)[0, 1] > 0.5
    assert np.corrcoef(capacity, age)[0, 1] < -0.5
    # The draws are independent of each other: no stratification within one sequence, no two alike, none that a trial could have.
    seeds = {d.seed for d in drawn}
    assert len(seeds) == len(set(age)) == 500
    assert abs(np.corrcoef(starts[:-1], starts[1:])[0, 1]) < 4 / math.sqrt(499)
    # Shares below one half are binomial; a Sobol sequence would have exactly half of each 256 there.
    counts = [(age[k : k + 16] < 0.5).sum() for k in range(0, 496, 16)]
    assert 2 < np.var(counts) < 8
    trials = {trial_seed(s, n) for s in range(5) for n in range(200)}
    assert not ({charge_seed(s, k) for s in range(5) for k in range(200)} | seeds) & (trials | set(range(5)))


def test_a_certificate_draws_what_no_search_and_no_trial_of_its_study_drew():
    """The tuner draws from the study's seed and trials from theirs; the same seed of a certificate gives other plants."""
    use = ChargingRange(replace(forced(), range=MODEST))
    chosen_on = {d.values["soc_start"] for seed in (0, trial_seed(0, 0), trial_seed(0, 1)) for d in use.draw(64, seed)}
    certified = {use.draw(1, charge_seed(0, index))[0].values["soc_start"] for index in range(64)}
    assert len(certified) == 64
    assert not certified & chosen_on


def test_the_controller_does_not_know_the_plant():
    problem = forced(current_min_A=0.0, steps=60)
    use = ChargingRange(replace(problem, range=ChargingRangeSettings(resistance=0.2, capacity=0.1)))
    drawn = use.draw(32, 0)
    nominal, _, _ = evaluate(problem, np.array(THETA), 0)
    assert nominal.feasible
    for one, episode in zip(drawn, use.run([np.array(THETA)] * 32, drawn), strict=True):
        score = use.score(episode)
        more = 1.0 + one.values["resistance"][0]
        voltage = np.array(episode.signal("voltage_V"))
        assert score.excess["voltage_max_V"] == pytest.approx(voltage.max() - 4.2)
        # The model is perfect but for the resistance: what is more of it is over the limit, nothing else is.
        assert score.feasible or more > 1.0
        assert not score.feasible or more < 1.05
        gained = episode.signal("soc")[1][0] - 0.6
        expected = episode.input[0, 0] * episode.sampling_time_s / 3600 / (2.0 * (1 + one.values["capacity"][0]))
        assert gained == pytest.approx(expected, rel=0.02)


def test_the_drawn_start_is_scored_from_there():
    problem = forced(current_min_A=0.0, steps=60, backoff=Backoff(nodes=2, upper_V=0.02), voltage_noise_sd_V=1e-3)
    (charge,) = charges(problem, ChargingRangeSettings(soc_start=(0.75, 0.75)), 1)
    same = replace(problem, episode=replace(problem.episode, soc_start=0.75))
    expected, other, _ = evaluate(same, np.array(THETA), charge.seed)
    np.testing.assert_allclose(charge.episode.input, other.input, atol=1e-5)
    assert charge.score.objective == pytest.approx(expected.objective, rel=1e-5)
    assert charge.score.metrics["t80_min"] == pytest.approx(expected.metrics["t80_min"], rel=1e-4)


def test_an_electrochemical_plant_is_varied():
    known = Electrochemical("SPM", resistance_scale=1.2)
    settings = ChargingRangeSettings(resistance=0.3, capacity=0.1, fade=0.2, growth=0.5, soc_start=(0.4, 0.6), voltage_bias_V=0.01)
    use = ChargingRange(replace(forced(plant=known), range=settings))
    for one in use.draw(32, 0):
        plant, v = use.plant_of(one), use.values(one)
        age, resistance, capacity = v["age"][0], v["resistance"][0], v["capacity"][0]
        assert plant.settings.capacity_scale == pytest.approx((1 + capacity) * (1 - 0.2 * age))
        assert plant.settings.resistance_scale == pytest.approx(max(1.0, 1.2 * (1 + resistance) * (1 + 0.5 * age)))
        assert plant.settings.ambient_K == known.ambient_K
        assert (plant.soc_start, plant.sensors.bias["voltage_V"]) == (v["soc_start"][0], v["voltage_bias_V"][0])
    assert default_range(forced(plant=known)).names == ("soc_start", "resistance", "capacity", "fade", "growth")


def test_an_electrochemical_plant_is_charged_and_certified(tmp_path):
    # A single particle that is charged for half a minute.
    problem = forced(plant=Electrochemical("SPM"), steps=3, current_min_A=0.0)
    problem = replace(problem, range=ChargingRangeSettings(soc_start=(0.4, 0.6), capacity=0.2, growth=0.5))
    everything = [charge for portion in run_charges(problem, THETA, seed=0, episodes=2) for charge in portion]
    # Different cells of different make: what is charged in the first interval follows the drawn capacity.
    gained = [(c.episode.signal("soc")[1][0] - start(c)) / c.episode.input[0, 0] for c in everything]
    capacity = [1 + c.values["capacity"][0] for c in everything]
    assert gained[0] / gained[1] == pytest.approx(capacity[1] / capacity[0], rel=1e-3)
    told = write_certificate(tmp_path / "c.json", problem, everything, theta={}, origin={}, seed=0, confidence=0.95)
    assert "not varied: resistance_by_node, capacitance, capacitance_by_node" in told["drawn"]
    assert verify(tmp_path / "c.json") == []


@pytest.mark.parametrize(
    ("plant", "settings", "words"),
    [
        (object(), NONE, "the cell's circuit or an electrochemical model"),
        (Electrochemical("SPM"), ChargingRangeSettings(resistance_by_node=0.1), "resistance_by_node = 0.1, allowed is 0"),
        (Electrochemical("SPM"), ChargingRangeSettings(capacitance=0.1), "capacitance = 0.1, allowed is 0"),
    ],
)
def test_what_a_plant_cannot_vary_is_refused_by_name(plant, settings, words):
    with pytest.raises(ValueError, match=words):
        charges(forced(plant=plant), settings, 1)


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="all episodes are the same"):
        charges(forced(), replace(NONE, soc_start=(0.5, 0.5)), 3)
    with pytest.raises(ValueError, match="range = None"):
        charges(forced(), None, 3)
    assert len(charges(forced(voltage_noise_sd_V=1e-3), NONE, 3)) == 3


@pytest.fixture
def certificate(tmp_path):
    problem = replace(forced(voltage_noise_sd_V=0.002, soc_start=0.5), range=MODEST)
    everything = charges(problem, MODEST, 12)
    path = tmp_path / "c.json"
    write_certificate(
        path, problem, everything, theta={"backoff_V[0]": 0.0, "backoff_V[1]": 0.0}, origin={"study": "s", "trial": 0},
        seed=0, confidence=0.95,
    )  # fmt: skip
    return path


def test_a_true_certificate_is_verified_and_says_what_was_judged(certificate):
    stated = json.loads(certificate.read_text())
    assert verify(certificate) == []
    assert 0 < stated["figures"]["violations"] < 12
    with np.load(traces_of(certificate)) as archive:
        # Judged without noise, kept as measured too.
        noise = archive["measured_end.voltage_V"] - archive["end.voltage_V"]
        assert noise.std() == pytest.approx(0.002, rel=0.25)
        nodes = archive["drawn.capacitance_by_node"]
    assert nodes.shape == (12, len(CELL.soc))
    assert (stated["format"], stated["range"]["soc_start"], stated["range"]["fade"]) == ("chargetune certificate 2", [0.4, 0.6], 0.05)
    assert set(stated["range"]) == set(stated["meaning"])


def test_a_certificate_of_format_1_is_still_verified(tmp_path):
    data = Path(__file__).parent / "data"
    for file in data.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    path = tmp_path / "format-1.json"
    assert verify(path) == []
    original = path.read_text()
    for name, value, found in (("spread", {"growth": 0.0}, "spread.resistance"), ("figures", {"violations": 1}, "violations")):
        resealed(path, lambda stated, name=name, value=value: stated[name].update(value))
        assert found in {d.name for d in verify(path)}
        path.write_text(original)


def test_a_trace_that_starts_elsewhere_than_drawn_is_named(certificate):
    traces = traces_of(certificate)
    with np.load(traces) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays["drawn.soc_start"] = arrays["drawn.soc_start"] - 1e-4
    np.savez_compressed(traces, **arrays)
    assert {"drawn.soc_start", "soc_start"} <= {d.name for d in verify(certificate)}


def traces_of(path):
    return path.with_name(json.loads(path.read_text())["traces"]["file"])


def resealed(path, change):
    """Change a certificate and make its own hash fit again, as a careful forger would."""
    stated = json.loads(path.read_text())
    change(stated)
    stated.pop("sha256")
    content = json.dumps(stated, sort_keys=True, separators=(",", ":"))
    stated["sha256"] = hashlib.sha256(content.encode()).hexdigest()
    path.write_text(json.dumps(stated))


def test_each_tampered_figure_is_named(certificate):
    original = certificate.read_text()
    for name, value in json.loads(original)["figures"].items():

        def change(stated, name=name, value=value):
            stated["figures"][name] = 1 if value is None else value + 1e-6 if isinstance(value, float) else value + 1

        resealed(certificate, change)
        assert [d.name for d in verify(certificate)] == [name]
        certificate.write_text(original)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda c: c["limits"][0].update(tolerance=0.1), {"violations", "voltage_max_V.violations"}),
        (lambda c: c["limits"][0].update(bound=4.3), {"voltage_max_V.worst_excess"}),
        (lambda c: c.update(confidence=0.5), {"violation_probability_upper"}),
        (lambda c: c["figures"].pop("violations"), {"violations"}),
        (lambda c: c["figures"].update(t50_min=3.0), {"t50_min"}),
        (lambda c: c["range"].update(resistance=0.0001), {"range.resistance"}),
        (lambda c: c["range"].update(capacitance_by_node=0.01), {"range.capacitance_by_node"}),
        (lambda c: c["range"].update(soc_start=[0.4, 0.45]), {"range.soc_start"}),
        (lambda c: c["range"].update(soc_start=None), {"range.soc_start"}),
        (lambda c: c["range"].update(fade=0.0), {"range.age"}),
        (lambda c: c["range"].update(resistance_by_node=0.1), {"range.resistance_by_node"}),
        (lambda c: c["traces"].update(sha256="0" * 64), {"traces.sha256"}),
    ],
)  # fmt: skip
def test_other_tampering_is_named(change, names, certificate):
    resealed(certificate, change)
    assert names <= {d.name for d in verify(certificate)}


def test_a_changed_theta_breaks_the_seal(certificate):
    certificate.write_text(certificate.read_text().replace('"backoff_V[0]": 0.0', '"backoff_V[0]": 0.1'))
    assert [d.name for d in verify(certificate)] == ["sha256"]


def test_changed_traces_are_named_by_their_hash_and_by_the_figures(certificate):
    traces = traces_of(certificate)
    with np.load(traces) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays["end.voltage_V"] = np.minimum(arrays["end.voltage_V"], 4.2)
    arrays["start.voltage_V"] = np.minimum(arrays["start.voltage_V"], 4.2)
    np.savez_compressed(traces, **arrays)
    assert {"traces.sha256", "violations", "voltage_max_V.worst_excess"} <= {d.name for d in verify(certificate)}
    traces.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="no NumPy archive"):
        verify(certificate)


@pytest.mark.parametrize("text", ["", "[]", '{"format": "other"}', '{"format": "chargetune certificate 1"}'])
def test_what_is_no_certificate_is_refused(text, tmp_path):
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"c\.json"):
        verify(path)


@pytest.mark.parametrize(("violations", "episodes"), [(0, 1), (0, 300), (3, 12), (150, 300), (299, 300), (300, 300), (40, 10_000)])
def test_both_ways_to_the_bound_agree(violations, episodes):
    from chargetune.battery.certification.clopper_pearson import violation_bound

    assert upper_bound(violations, episodes, 0.95) == pytest.approx(violation_bound(violations, episodes, 0.95), rel=1e-10)
    if not violations:
        assert upper_bound(0, episodes, 0.95) == pytest.approx(1 - 0.05 ** (1 / episodes), rel=1e-10)


@pytest.mark.parametrize(
    ("changes", "interval"),
    [
        ({"soc_start": 0.05, "soc_start_error": -0.04}, (0.0, 0.08)),
        ({"soc_start": 0.6, "soc_start_error": 0.3, "soc_target": 1.0}, (0.3, 0.9)),
        ({"soc_start": 0.85, "soc_target": 1.0, "voltage_max_V": 4.1}, (0.75, 0.95)),
    ],
)
def test_each_start_that_may_be_drawn_is_charged(changes, interval):
    """Drawn may be what no problem may state: a cell at rest above its limit."""
    problem = forced(current_min_A=0.0, backoff=Backoff(nodes=2, upper_V=0.02), **changes)
    everything = charges(problem, ChargingRangeSettings(soc_start=interval), 12)
    assert np.ptp([start(charge) for charge in everything]) > 0.3 * (interval[1] - interval[0])
    for charge in everything:
        assert charge.score is not None, charge.episode.message


@pytest.mark.parametrize("changes", [{"soc_start": 0.0}, {"soc_start": 0.01}, {"soc_start": 0.6, "charge_time_to_soc": 0.601}])
def test_the_default_range_fits_every_problem(changes):
    problem = forced(current_min_A=0.0, backoff=Backoff(nodes=2, upper_V=0.02), **changes)
    low, high = replace(problem, range=default_range(problem)).range.soc_start
    assert 0.0 <= low <= high <= changes["soc_start"] + 0.03


def killed(path, at, monkeypatch, everything):
    """Write a second certificate over the first, and die just before change ``at`` of the folder; the changes so far."""
    seen = []

    def step(real):
        def run(place, *arguments, **settings):
            if len(seen) == at:
                raise SystemExit("killed")
            seen.append(place.name)
            return real(place, *arguments, **settings)

        return run

    with monkeypatch.context() as patch:
        patch.setattr(type(path), "replace", step(type(path).replace))
        patch.setattr(type(path), "unlink", step(type(path).unlink))
        try:
            write_certificate(
                path, replace(forced(voltage_noise_sd_V=0.002, soc_start=0.5), range=MODEST), everything,
                theta={"backoff_V[0]": 0.0, "backoff_V[1]": 0.0}, origin={"study": "s", "trial": 1}, seed=1, confidence=0.95,
            )  # fmt: skip
        except SystemExit:
            return True
    return False


def test_a_certificate_is_replaced_as_a_whole(certificate, monkeypatch):
    everything = charges(forced(voltage_noise_sd_V=0.002, soc_start=0.5), MODEST, 12, seed=1)
    certificate.with_suffix(".png").write_bytes(b"figure of the old one")
    bystander = certificate.with_name("c-notes.npz")
    bystander.write_bytes(b"somebody else's")
    trials = []
    for at in range(20):
        dead = killed(certificate, at, monkeypatch, everything)
        assert verify(certificate) == [], f"killed before change {at}"
        trials.append(json.loads(certificate.read_text())["origin"]["trial"])
        assert not (certificate.with_suffix(".png").exists() and trials[-1]), "the old figure is beside the new certificate"
        if not dead:
            break
    assert not dead
    assert trials[0] == 0
    assert sorted(trials) == trials
    assert trials[-1] == 1
    stated = json.loads(certificate.read_text())
    assert bystander.exists()
    assert stated["traces"]["file"] == f"c-{stated['traces']['sha256'][:12]}.npz"
