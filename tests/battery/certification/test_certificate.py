"""Certificates: a controller with a known violation rate, draws, and what the second arithmetic makes of tampered ones."""

import hashlib
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.certification.certificate import figures, run_charges, write_certificate
from chargetune.battery.certification.variations import PlantVariation, Variations
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.tunables import Backoff
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.episode.episode import Ending
from chargetune.study.evaluation import trial_seed
from chargetune.verify import upper_bound, verify
from charging_problems import changed, charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()
NONE = PlantVariation(0, 0, 0, 0, 0, 0)
MODEST = PlantVariation(soc_start=0.1, resistance=0.002, growth=0.0)
ONLY_START = replace(NONE, soc_start=0.1)
THETA = (0.0, 0.0)


def forced(**changes):
    """A controller that has to charge with 4 A for 6 intervals: it breaks the limit where the charge starts late."""
    settings = {"mismatch_seed": None, "backoff": Backoff(nodes=2), "steps": 6, "soc_start": 0.6, "current_min_A": 4.0}
    return charging_problem(CELL, **(settings | changes))


def charges(problem, spread, episodes, seed=0):
    return [charge for portion in run_charges(problem, THETA, spread=spread, seed=seed, episodes=episodes) for charge in portion]


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
    np.testing.assert_array_equal(counted, [charge.draw.soc_start >= edge for charge in everything])
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
    (kept,) = charges(forced(soc_start=0.5), replace(NONE, soc_start=0.001), 1)
    assert kept.score.feasible
    broken = replace(kept, score=replace(kept.score, excess={**kept.score.excess, "voltage_max_V": 0.01}))
    draw, tolerances = np.random.default_rng(0), kept.score.tolerance
    for p in (0.02, 0.3):
        sample = draw.uniform(size=(400, 50)) < p
        held = [figures([broken if b else kept for b in row], tolerances, 0.9)["violation_probability_upper"] >= p for row in sample]
        # 0.9 less three standard deviations of 400 repetitions.
        assert np.mean(held) >= 0.9 - 3 * math.sqrt(0.09 / 400)


def test_an_episode_that_does_not_come_to_its_end_counts_as_a_violation():
    (kept,) = charges(forced(soc_start=0.5), replace(NONE, soc_start=0.001), 1)
    ended = replace(kept, score=None, episode=kept.episode.cut(3, Ending.SOLVER, "no finite input"))
    found = figures([kept, ended], kept.score.tolerance, 0.95)
    assert (found["not_completed"], found["violations"], found["voltage_max_V.violations"]) == (1, 1, 0)
    assert found["t80_min.worst"] is None


def test_quantiles_by_hand():
    (one,) = charges(forced(soc_start=0.5), replace(NONE, soc_start=0.001), 1)
    made = [replace(one, score=replace(one.score, metrics={**one.score.metrics, "t80_min": float(k)})) for k in range(1, 20)]
    never = replace(one, score=replace(one.score, metrics={**one.score.metrics, "t80_min": None}))
    found = figures([*made, never], one.score.tolerance, 0.95)
    assert [found[f"t80_min.{q}"] for q in ("q05", "q50", "q95", "worst")] == [1.0, 10.0, 19.0, None]


def test_draws_are_within_the_spread_and_depend_on_seed_and_index_alone():
    spread, problem = PlantVariation(), forced()
    drawn = [spread.draw(problem, 3, index) for index in range(500)]
    assert drawn[7] == PlantVariation().draw(problem, 3, 7) != PlantVariation().draw(problem, 4, 7)
    start = np.array([d.soc_start for d in drawn])
    age = np.array([d.age for d in drawn])
    r0, capacity = (np.array([d.factors[name] for d in drawn]) for name in ("R0_ohm", "capacity_Ah"))
    assert start.min() >= 0.57
    assert start.max() <= 0.63
    assert np.ptp(start) > 0.05
    # Without the age, R0 is 1 +- 0.05 and the capacity 1 +- 0.02.
    assert np.abs(r0 / (1 + 0.1 * age) - 1).max() <= 0.05
    assert np.abs(capacity / (1 - 0.05 * age) - 1).max() <= 0.02
    assert np.corrcoef(r0, age)[0, 1] > 0.5
    assert np.corrcoef(capacity, age)[0, 1] < -0.5
    # Never a seed of a trial.
    seeds = {d.seed for d in drawn}
    assert len(seeds) == 500
    assert not seeds & {trial_seed(s, n) for s in range(5) for n in range(200)}


def test_the_drawn_plant_differs_and_the_controller_does_not_know():
    problem = forced(current_min_A=0.0, steps=60)
    draw = PlantVariation().draw(problem, 0, 0)
    harder = replace(draw, soc_start=0.6, factors={**dict.fromkeys(draw.factors, 1.0), "R0_ohm": 1.2})
    same = replace(harder, factors=dict.fromkeys(draw.factors, 1.0))
    variations = Variations(problem)
    nominal = run_charge(problem, None)
    np.testing.assert_allclose(variations.run(same, THETA)[1].input, nominal.input, atol=1e-6)
    score, episode = variations.run(harder, THETA)
    # A perfect model before; now R0 is a fifth larger than believed: about 0.2 x 61 mOhm x I more than the limit.
    start, _ = episode.signal("voltage_V")
    over = start.max() - 4.2
    assert score.excess["voltage_max_V"] == pytest.approx(max(map(np.max, episode.signal("voltage_V"))) - 4.2)
    assert over == pytest.approx(0.2 * 0.061 * episode.input[np.argmax(start), 0], rel=0.1)
    # A larger capacity charges more slowly.
    larger = replace(same, factors={**same.factors, "capacity_Ah": 1.1})
    gained = [variations.run(d, THETA)[1].signal("soc")[1][0] - 0.6 for d in (same, larger)]
    assert gained[0] / gained[1] == pytest.approx(1.1, rel=1e-6)


def test_an_electrochemical_plant_is_varied_and_another_is_refused():
    with pytest.raises(ValueError, match="allowed are the cell's circuit and an electrochemical model"):
        Variations(forced(plant=object()))
    # A single particle that is charged for half a minute.
    problem = forced(plant=Electrochemical("SPM"), steps=3, current_min_A=0.0, kalman=None)
    one = PlantVariation().draw(problem, 0, 0)
    plain, smaller, harder = (
        Variations(problem).run(replace(one, soc_start=0.5, factors={**dict.fromkeys(one.factors, 1.0), **factors}), THETA)[1]
        for factors in ({}, {"capacity_Ah": 0.8}, {"R0_ohm": 1.5})
    )
    current = np.array([episode.input[0, 0] for episode in (plain, smaller, harder)])
    gained = np.array([episode.signal("soc")[1][0] - 0.5 for episode in (plain, smaller, harder)]) / current
    assert gained[1] / gained[0] == pytest.approx(1 / 0.8, rel=1e-3)
    assert harder.signal("voltage_V")[0][0] > plain.signal("voltage_V")[0][0] + 0.005


def test_nothing_to_draw_is_refused():
    with pytest.raises(ValueError, match="all episodes are the same"):
        charges(forced(), NONE, 3)
    assert len(charges(forced(voltage_noise_sd_V=1e-3), NONE, 3)) == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"fade": -0.1}, "fade"), ({"resistance": 1.0}, "resistance"), ({"soc_start": math.nan}, "soc_start")],
)
def test_a_bad_spread_is_refused(changes, words):
    with pytest.raises(ValueError, match=f"spread: {words}"):
        PlantVariation(**changes)


@pytest.fixture
def certificate(tmp_path):
    problem = forced(voltage_noise_sd_V=0.002, soc_start=0.5)
    everything = charges(problem, MODEST, 12)
    path = tmp_path / "c.json"
    write_certificate(
        path, problem, everything, theta={"backoff_V[0]": 0.0, "backoff_V[1]": 0.0}, origin={"study": "s", "trial": 0},
        spread=MODEST, seed=0, confidence=0.95,
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
        (lambda c: c["spread"].update(resistance=0.0001), {"spread.resistance"}),
        (lambda c: c["spread"].update(soc_start=0.001), {"spread.soc_start"}),
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
    ("changes", "width"),
    [
        ({"soc_start": 0.05, "soc_start_error": -0.04}, 0.03),
        ({"soc_start": 0.6, "soc_start_error": 0.3, "soc_target": 1.0}, 0.3),
        ({"soc_start": 0.6, "charge_time_to_soc": 0.65}, 0.2),
        ({"soc_start": 0.85, "soc_target": 1.0, "voltage_max_V": 4.1}, 0.1),
    ],
)
def test_each_start_that_may_be_drawn_is_charged(changes, width):
    """Drawn may be what no problem may state: an estimate beyond empty or full, a start past the mark, a cell at rest above its limit."""
    problem = forced(current_min_A=0.0, backoff=Backoff(nodes=2, upper_V=0.02), **changes)
    everything = charges(problem, replace(NONE, soc_start=width), 12)
    starts = np.array([charge.draw.soc_start for charge in everything])
    assert np.ptp(starts) > 0.5 * width
    for charge in everything:
        assert charge.score is not None, charge.episode.message


def test_the_drawn_start_is_scored_from_there():
    problem = forced(current_min_A=0.0, steps=60, backoff=Backoff(nodes=2, upper_V=0.02))
    draw = PlantVariation().draw(problem, 0, 0)
    draw = replace(draw, soc_start=0.75, factors=dict.fromkeys(draw.factors, 1.0))
    score, episode = Variations(problem).run(draw, THETA)
    same = changed(problem, soc_start=0.75)
    expected, other, _ = evaluate(same, np.array(THETA), draw.seed)
    np.testing.assert_allclose(episode.input, other.input, atol=1e-6)
    assert score.objective == pytest.approx(expected.objective, rel=1e-6)
    assert score.metrics["t80_min"] == pytest.approx(expected.metrics["t80_min"], rel=1e-5)


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
                path, forced(voltage_noise_sd_V=0.002, soc_start=0.5), everything,
                theta={"backoff_V[0]": 0.0, "backoff_V[1]": 0.0}, origin={"study": "s", "trial": 1}, spread=MODEST, seed=1, confidence=0.95,
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
